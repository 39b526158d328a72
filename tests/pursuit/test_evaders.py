"""Scripted evaders: against plain Python, and what holds for all of them; the
curriculum and the draws.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax import UserError, make
from openjax.pursuit import SCENARIOS, PursuitSettings, scenario_task
from openjax.pursuit.evaders import (
    EVADERS,
    HELD_OUT,
    SCRIPTED,
    VALIDATED,
    draw_evader,
    init_network,
)
from openjax.pursuit.evaders.behaviours import DIRECTIONS, MARGIN, MEMORY, Scene, directions, greedy

ALL = SCRIPTED
SETTINGS = PursuitSettings(physics="stops", evaders=ALL, episode_length=240)


@pytest.fixture(scope="module")
def flown():
    """Every evader twice on every layout, against pursuers that fly at random: states
    (T, layouts * 2 * evaders, ...).
    """
    environment = make(SETTINGS, max_pillars=6)
    settings = environment.settings
    tasks = [scenario_task(settings, scenario) for scenario in SCENARIOS.values()]
    tasks = jax.tree.map(
        lambda *leaves: jnp.repeat(jnp.stack(leaves), 2 * len(ALL), axis=0), *tasks
    )
    kinds = jnp.tile(jnp.arange(len(ALL)), 2 * len(SCENARIOS))
    actions = jax.random.uniform(jax.random.key(1), (240, 3, 4), minval=-0.3, maxval=0.4)

    @jax.jit
    @jax.vmap
    def fly(key, task, kind):
        _, state = environment.reset_to(key, task)
        state = state.replace(evader=draw_evader(settings, key, task.pursuer_position, kind=kind))

        def one(state, action):
            _, state, *_ = environment.step(key, state, action)
            return state, state

        return state, jax.lax.scan(one, state, actions)[1]

    start, states = fly(jax.random.split(jax.random.key(0), len(kinds)), tasks, kinds)
    return settings, start, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), states)


@pytest.mark.slow
def test_every_evader_stays_inside_and_out_of_pillars(flown):
    settings, _, states = flown
    place = np.asarray(states.evader_position)
    assert np.isfinite(place).all()
    assert (np.linalg.norm(place[..., :2], axis=-1) < settings.arena_radius).all()
    assert (place[..., 2] > 0).all() and (place[..., 2] < settings.arena_height).all()
    to_axis = np.linalg.norm(
        place[..., None, :2] - np.asarray(states.task.pillar_position), axis=-1
    )
    in_use = np.asarray(states.task.pillar_active)
    assert to_axis[in_use].min() >= settings.pillar_radius


@pytest.mark.slow
def test_speed_and_acceleration_are_bounded(flown):
    settings, _, states = flown
    velocity = np.asarray(states.evader_velocity)
    speed = np.linalg.norm(velocity, axis=-1)
    assert speed.max() <= settings.evader_speed * (1 + 1e-3)
    heavy = np.asarray(states.evader.kind[0]) == ALL.index("heavy")
    place = np.asarray(states.evader_position)
    to_axis = np.linalg.norm(
        place[..., None, :2] - np.asarray(states.task.pillar_position), axis=-1
    )
    to_axis = np.where(np.asarray(states.task.pillar_active), to_axis, np.inf).min(-1)
    # what is in its way stops it at once
    near = (to_axis < settings.pillar_radius + MARGIN + 0.02) | (place[..., 2] < MARGIN + 0.02)
    near |= np.linalg.norm(place[..., :2], axis=-1) > settings.arena_radius - MARGIN - 0.02
    near |= place[..., 2] > settings.arena_height - MARGIN - 0.02
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / settings.time_step
    free = ~near[1:] & ~near[:-1]
    assert free[:, heavy].sum() > 200
    assert change[:, heavy][free[:, heavy]].max() < EVADERS["heavy"].acceleration[0] * 1.01
    assert change[:, ~heavy].max() > 50  # the others may turn at once


@pytest.mark.slow
def test_frozen_ones_stay_and_the_others_move(flown):
    _, start, states = flown
    flown_off = np.linalg.norm(
        np.asarray(states.evader_position) - np.asarray(start.evader_position), axis=-1
    ).max(0)
    by_kind = {name: flown_off[np.asarray(start.evader.kind) == i] for i, name in enumerate(ALL)}
    assert by_kind.pop("frozen").max() == 0.0
    assert all(moved.max() > 0.3 for moved in by_kind.values()), by_kind


def plain_greedy(settings, position, pursuers, known, pillars, look_ahead, hiding):
    """The direction in plain Python, and how much better it is than the next best."""

    def blocked(a, b):
        for pillar in pillars:
            along = np.dot(pillar - a[:2], (b - a)[:2]) / max(
                np.dot((b - a)[:2], (b - a)[:2]), 1e-12
            )
            if (
                0 <= along <= 1
                and np.linalg.norm(a[:2] + along * (b - a)[:2] - pillar) < settings.pillar_radius
            ):
                return True
        return False

    scores = []
    for direction in directions(DIRECTIONS).astype(float):
        end = position + settings.evader_speed * look_ahead * direction
        push = np.zeros(2)
        for pillar in pillars:
            offset = end[:2] - pillar
            distance = np.linalg.norm(offset)
            push += offset / distance * max(settings.pillar_radius + MARGIN - distance, 0.0)
        end[:2] += push
        end[:2] *= min(1.0, (settings.arena_radius - MARGIN) / np.linalg.norm(end[:2]))
        end[2] = np.clip(end[2], MARGIN, settings.arena_height - MARGIN)
        distances = [
            np.linalg.norm(end - pursuer) + (hiding if blocked(pursuer, end) else 0.0)
            for pursuer, is_known in zip(pursuers, known, strict=True)
            if is_known
        ]
        scores.append(-np.inf if blocked(end, position) else min(distances))
    best = int(np.argmax(scores))
    return directions(DIRECTIONS)[best], scores[best] - sorted(scores)[-2]


def test_greedy_against_plain_python():
    settings = PursuitSettings()
    draw = np.random.default_rng(3)
    decide = jax.jit(greedy)
    compared = 0
    for _ in range(60):
        position, *pursuers = draw.uniform([-0.6, -0.6, 0.1], [0.6, 0.6, 1.1], (4, 3))
        pillars = draw.uniform(-0.6, 0.6, (5, 2))
        pillars = pillars[np.linalg.norm(pillars - position[:2], axis=1) > 0.12]
        active = np.arange(5) < len(pillars)
        padded = np.concatenate([pillars, np.zeros((5 - len(pillars), 2))])
        known = np.array([True, *(draw.uniform(size=2) < 0.7)])
        look_ahead = draw.uniform(0.05, 0.4)
        hiding = draw.choice([0.0, 0.3])
        scene = Scene(
            settings,
            *(jnp.asarray(x, jnp.float32) for x in (position, np.zeros(3), np.array(pursuers))),
            jnp.asarray(known),
            jnp.asarray(padded, jnp.float32),
            jnp.asarray(active),
            *(jnp.float32(x) for x in (look_ahead, hiding, settings.evader_speed)),
        )
        wish = decide(scene, jnp.zeros(MEMORY))[0]
        expected, lead = plain_greedy(
            settings, position, pursuers, known, pillars, look_ahead, hiding
        )
        if lead > 1e-4:  # else rounding decides
            compared += 1
            np.testing.assert_allclose(wish, expected, atol=1e-6)
    assert compared > 40


def test_one_that_knows_of_no_pursuer_waits():
    settings = PursuitSettings(evaders=("greedy",))
    environment = make(settings, physics="stops", start_attitude="level")
    _, state = jax.jit(environment.reset_to)(
        jax.random.key(0), scenario_task(settings, SCENARIOS["hidden"])
    )
    assert not state.in_sight.any()
    step = jax.jit(environment.step)
    for sees_all in (0.0, 1.0):
        numbers = state.evader.numbers | {"sees_all": jnp.float32(sees_all)}
        own = state.replace(evader=state.evader.replace(numbers=numbers))
        after = step(jax.random.key(0), own, jnp.zeros((3, 4)))[1]
        moved = np.linalg.norm(after.evader_position - state.evader_position)
        np.testing.assert_allclose(
            moved, sees_all * settings.evader_speed * settings.time_step, rtol=1e-3
        )


def test_draws_of_worlds():
    """Kinds with the odds that the names give, numbers from the lists; a curriculum
    from the first alone to all.
    """
    settings = PursuitSettings(evaders=("field", "greedy", "greedy", "wall_runner"))
    keys = jax.random.split(jax.random.key(5), 6000)
    drawn = jax.jit(jax.vmap(lambda key: draw_evader(settings, key, jnp.zeros((3, 3)))))(keys)
    counts = np.bincount(np.asarray(drawn.kind), minlength=4) / 6000
    np.testing.assert_allclose(counts, 0.25, atol=0.03)
    greedy_worlds = np.isin(np.asarray(drawn.kind), (1, 2))
    numbers = {name: np.asarray(value) for name, value in drawn.numbers.items()}
    for name in ("look_ahead", "hiding", "sees_all"):
        values, found = np.unique(numbers[name][greedy_worlds], return_counts=True)
        wanted, odds = np.unique(np.float32(getattr(EVADERS["greedy"], name)), return_counts=True)
        np.testing.assert_array_equal(values, wanted)
        np.testing.assert_allclose(found / found.sum(), odds / odds.sum(), atol=0.05)
    drawn_for = jax.jit(
        jax.vmap(lambda key, share: draw_evader(settings, key, jnp.zeros((3, 3)), share), (0, None))
    )
    for share in (0.0, 0.4):
        part = drawn_for(keys, jnp.float32(share))
        others = np.asarray(part.kind) != 0
        np.testing.assert_allclose(others.mean(), 0.75 * share, atol=0.03)
        assert (np.asarray(part.numbers["speed"])[others] <= 0.5 + 0.5 * share).all()
        assert (np.asarray(part.numbers["speed"])[~others] == 1.0).all()


def test_the_papers_game_holds_nothing_more():
    environment = make(physics="stops")
    assert jax.eval_shape(environment.reset, jax.random.key(0))[1].evader is None


def test_networks_of_several_seeds_start_at_once():
    """A CPU of two cores once waited for ever for decompositions of several
    matrices.
    """

    def start(key):
        return [jax.vmap(init_network)(jax.random.split(own, 3)) for own in jax.random.split(key)]

    for layers in jax.jit(start)(jax.random.key(0)):
        np.testing.assert_allclose(np.std(layers["hidden"]["kernel"]), (2 / 64) ** 0.5, rtol=0.05)


def test_sets_share_nobody_and_unknown_ones_are_refused():
    trained = [name for name, row in EVADERS.items() if row.of == "train"]
    assert sorted([*trained, *VALIDATED, *HELD_OUT]) == sorted(ALL)
    assert make(evader="greedy").settings.evaders == ("greedy",)
    for given, text in (
        ({"evader": "nobody"}, "nobody: unknown; there are field"),
        ({"evaders": ()}, "is empty"),
    ):
        with pytest.raises(UserError, match=text):
            make(**given)
