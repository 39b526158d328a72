"""Evaders that learn: each from its own samples, in the direction that pays; and who
flies what in a world.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax import make
from openjax.errors import UserError
from openjax.learning.learners.evasion import EvaderLearner
from openjax.learning.presets import preset
from openjax.learning.settings import EvaderLearningSettings
from openjax.policy import PolicyParameters
from openjax.pursuit import uniform_task
from openjax.pursuit.evaders import init_network, scene_of
from openjax.pursuit.evaders.learned import STEPS, features, outputs, outputs_of

WORLDS = 256
ENVIRONMENT = make(
    evaders=("field", "learned", "greedy", "learned"), physics="stops", max_pillars=5
)


class Fast(EvaderLearningSettings):
    """Learns in a few updates."""

    EPOCHS = 4
    LEARNING_RATE = 3e-3
    INITIAL_LOG_STD = 0.0


HOW = Fast()
LEARNING = EvaderLearner(HOW, ENVIRONMENT, updates=1)
PURSUERS = PolicyParameters(actor={}, critic={}, predictor={})
act = jax.jit(LEARNING.act)
learn = jax.jit(LEARNING.improve)


@pytest.fixture(scope="module")
def worlds():
    """Worlds of all four evaders in turn, at their starts."""

    def begin(key, kind):
        task = uniform_task(ENVIRONMENT.settings, key).replace(evader=kind)
        return ENVIRONMENT.reset_to(key, task)[1]

    keys = jax.random.split(jax.random.key(0), WORLDS)
    return jax.jit(jax.vmap(begin))(keys, jnp.arange(WORLDS) % 4)


@pytest.fixture(scope="module")
def start():
    """The two networks before they learn."""
    return jax.jit(LEARNING.start)(PURSUERS, jax.random.key(1))


def test_each_learns_from_its_own_samples_what_pays(worlds, start):
    """Network 1 is caught at once where it flies to the left, network 0 whatever it
    does.
    """
    learning = EvaderLearner(HOW, ENVIRONMENT, updates=30)

    @jax.jit
    def improve(evaders, key):
        noise_key, order_key = jax.random.split(key)

        samples = learning.act(evaders, worlds, jax.random.normal(noise_key, (WORLDS, 3)))[1]
        caught = (samples.which == 0) | (samples.sample[:, 0] < 0.0)
        last = worlds.replace(statistics=worlds.statistics.replace(captured=caught))
        samples = jax.tree.map(lambda leaf: leaf[None], samples)
        return learning.improve(evaders, samples, last, order_key), caught

    evaders = start
    for key in jax.random.split(jax.random.key(2), 30):
        evaders, caught = improve(evaders, key)
    which, seen = jax.jit(learning.see)(evaders.actor, worlds)
    np.testing.assert_array_equal(which, np.tile([-1, 0, -1, 1], WORLDS // 4))
    told = jax.jit(outputs_of)
    before, after = (told(e.actor, which, seen)[0][which == 1, 0] for e in (start, evaders))
    moved = float(jnp.mean(after - before))
    assert moved > 0.5
    assert np.mean(np.asarray(caught)[which == 1]) < 0.2
    # nothing that it does makes a difference: no advantage, so no change of what it
    # does
    still = jax.tree.map(lambda a, b: np.abs(a[0] - b[0]).max(), evaders.actor, start.actor)
    assert max(jax.tree.leaves(still)) < 0.2 * moved


def test_a_network_without_a_world_stays_as_it_is(worlds, start):
    """Evaders that come in late haven't more noise by then than they begin with."""
    samples = act(start, worlds, jnp.ones((WORLDS, 3)))[1]
    samples = jax.tree.map(
        lambda leaf: leaf[None], samples.replace(which=jnp.where(samples.which == 0, 0, -1))
    )
    end = learn(start, samples, worlds, jax.random.key(2))
    changed = [
        np.any(np.asarray(a != b), axis=tuple(range(1, a.ndim)))
        for a, b in zip(*map(jax.tree.leaves, (start.networks, end.networks)), strict=True)
    ]
    np.testing.assert_array_equal(np.any(changed, axis=0), [True, False])


def test_a_network_that_flies_all_worlds_learns_as_if_alone(worlds):
    """Beside another one it gets its worlds some at a time."""
    alone = EvaderLearner(
        HOW, make(evaders=("learned",), physics="stops", max_pillars=5), updates=1
    )
    ended = worlds.replace(statistics=worlds.statistics.replace(captured=jnp.ones(WORLDS, bool)))
    one = jax.jit(alone.start)(PURSUERS, jax.random.key(1))
    kinds = worlds.evader.replace(kind=jnp.zeros(WORLDS, jnp.int32))
    samples = jax.jit(alone.act)(one, worlds.replace(evader=kinds), jnp.ones((WORLDS, 3)))[1]
    samples = jax.tree.map(lambda leaf: leaf[None], samples)
    two = jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), one)
    ends = [
        step(first, samples, ended, jax.random.key(2))
        for step, first in ((jax.jit(alone.improve), one), (learn, two))
    ]
    for mine, its in zip(*(jax.tree.leaves(end.networks) for end in ends), strict=True):
        np.testing.assert_allclose(its[0], mine[0], atol=1e-5)


def test_wishes_fly_only_where_a_network_acts(worlds, start):
    wish, samples = act(start, worlds, jnp.ones((WORLDS, 3)))
    acts = np.asarray(samples.which) >= 0
    assert (np.isnan(np.asarray(wish)).any(-1) == ~acts).all()
    step = jax.jit(jax.vmap(ENVIRONMENT.step, (None, 0, None, 0)))
    hover = jnp.zeros((3, 4))
    own = jnp.full((WORLDS, 3), jnp.nan)
    flown, alone = (
        np.asarray(step(jax.random.key(0), worlds, hover, w)[1].evader_position)
        for w in (wish, own)
    )
    plain = jax.jit(jax.vmap(ENVIRONMENT.step, (None, 0, None)))(jax.random.key(0), worlds, hover)[
        1
    ]
    np.testing.assert_array_equal(alone, plain.evader_position)
    np.testing.assert_array_equal(flown[~acts], alone[~acts])
    blank = worlds.replace(evader=worlds.evader.replace(memory=0.0 * worlds.evader.memory))
    memory = step(jax.random.key(0), blank, hover, wish)[1].evader.memory
    np.testing.assert_array_equal(memory[acts, -9:], worlds.drones.position[acts].reshape(-1, 9))
    assert (np.abs(flown - alone)[acts].max(-1) > 1e-4).mean() > 0.9


def test_every_place_flies_its_own_network(worlds):
    networks = jax.vmap(init_network)(jax.random.split(jax.random.key(3), 2))
    networks["output"]["kernel"] = jax.random.normal(
        jax.random.key(4), networks["output"]["kernel"].shape
    )
    which, seen = jax.jit(LEARNING.see)(networks, worlds)
    found = jax.jit(outputs_of)(networks, which, seen)
    for place in (0, 1):
        alone = jax.jit(outputs)(jax.tree.map(lambda leaf, i=place: leaf[i], networks), seen)
        for mine, its in zip(found, alone, strict=True):
            np.testing.assert_allclose(
                mine[which == place], its[which == place], rtol=1e-5, atol=1e-5
            )


def turned_drones(drones, turn, half):
    """Drones, each with its velocity and attitude turned by the quaternion `half` about
    z.
    """
    w, x, y, z = np.asarray(drones.quaternion).T
    c = half[0]
    s = half[3]
    product = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
    return drones.replace(velocity=drones.velocity @ turn.T, quaternion=jnp.asarray(product))


@pytest.mark.parametrize("own_axes", [True, False])
def test_in_its_own_axes_a_turned_game_is_the_same(worlds, own_axes):
    network = init_network(jax.random.key(5), own_axes=own_axes)
    network["output"]["kernel"] = jax.random.normal(
        jax.random.key(6), network["output"]["kernel"].shape
    )
    networks = jax.tree.map(lambda leaf: leaf[None], network)
    cosine = np.cos(0.7)
    sine = np.sin(0.7)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], np.float32)
    scene = scene_of(ENVIRONMENT.settings, jax.tree.map(lambda leaf: leaf[1], worlds))
    # nobody to be greedy about, whose directions are the world's
    scene = scene.replace(known=jnp.zeros(3, bool))
    moved = {name: getattr(scene, name) @ turn.T for name in ("position", "velocity", "pursuers")}
    turned = scene.replace(**moved, pillar_position=scene.pillar_position @ turn[:2, :2].T)
    # about half an angle, as quaternions turn
    half = np.array([np.cos(0.35), 0.0, 0.0, np.sin(0.35)], np.float32)
    turned = turned.replace(drones=turned_drones(scene.drones, turn, half))
    before = scene.pursuers + 0.1 * jax.random.normal(jax.random.key(7), (STEPS, 3, 3))

    @jax.jit
    def wish(scene, before):
        memory = jnp.concatenate(
            [jnp.zeros(worlds.evader.memory.shape[-1] - before.size), before.ravel()]
        )
        return outputs(network, features(networks, 0, scene, memory))[0]

    gap = jnp.abs(wish(turned, before @ turn.T) - wish(scene, before) @ turn.T).max()
    assert gap < 1e-4 if own_axes else gap > 0.1


def test_earlier_selves_fly_and_learn_nothing(worlds):
    """Of two learned evaders the second is an earlier self: its samples change nobody,
    and it becomes what the first was when it was drawn.
    """

    class Forgetful(Fast):
        POOL = 2
        POOL_EVERY = 1

    learning = EvaderLearner(Forgetful(past=1), ENVIRONMENT, updates=4)
    start = jax.jit(learning.start)(PURSUERS, jax.random.key(1))

    @jax.jit
    def improve(evaders, key, shift):
        samples = learning.act(evaders, worlds, jax.random.normal(key, (WORLDS, 3)))[1]
        of_past = (samples.which == 1)[:, None]
        samples = samples.replace(sample=samples.sample + shift * of_past)
        samples = jax.tree.map(lambda leaf: leaf[None], samples)
        caught = samples.sample[0, :, 0] < 0.0
        last = worlds.replace(statistics=worlds.statistics.replace(captured=caught))
        return learning.improve(evaders, samples, last, key)

    assert learning.number == 1
    evaders = start
    for key in jax.random.split(jax.random.key(2), 4):
        other = improve(evaders, key, 5.0)
        evaders = improve(evaders, key, 0.0)
        chex.assert_trees_all_equal(evaders.actor, other.actor)
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], evaders.flying) for i in (0, 1))
    drawn = jax.tree.map(lambda leaf: leaf[evaders.past[0]], evaders.pool)
    chex.assert_trees_all_equal(second, drawn)
    moved = jnp.abs(first["output"]["kernel"] - start.actor["output"]["kernel"][0]).max()
    assert moved > 0.0


def test_somebody_has_to_learn():
    with pytest.raises(UserError, match=r"past 2 leaves none of 2 .* at most 1"):
        preset("evaders", environment={"evaders": ("learned",) * 2}, evader_learning={"past": 2})
