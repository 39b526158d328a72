"""A learned evader: a small network with a memory, added to what the greedy evader of some
look-ahead would do.

Its memory holds where the pursuers were in the last steps. Pursuers and pillars are pooled, so that
their number and order don't matter. With zeros in its last layer, as it starts, it is that greedy
evader.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, PRNGKeyArray

from openjax.pursuit.axes import turned_back
from openjax.pursuit.evaders.behaviours import MEMORY, Scene, greedy
from openjax.pursuit.evaders.kinds import EVADERS
from openjax.pursuit.shapes import Count, Memory, Vector
from openjax.pursuit.teams import of_team

STEPS = 10
"""Steps that it remembers."""
WIDTH = 64
LOOK_AHEAD = (0.15, 0.5, 0.3)
"""Seconds that the greedy evaders look ahead as which networks start, one after the other: a best
response to who is caught out by a far-sighted one isn't found from a short-sighted one.
"""
_OWN = 9
_PURSUER = 16
_PILLAR = 4


def learned_place(names: tuple[str, ...], kind: Int32[Array, "*worlds"]) -> Int32[Array, "*worlds"]:
    """The place among the learned evaders of those at the places `kind` (...) in `names`; -1 for
    others.
    """
    is_learned = np.array([EVADERS[name].behaviour == "learned" for name in names])
    return jnp.asarray(np.where(is_learned, np.cumsum(is_learned) - 1, -1))[kind]


def init_network(
    key: PRNGKeyArray, number: int | Count = 0, own_axes: bool = False
) -> dict[str, Any]:
    """Parameters of a network (actor and critic alike) whose output, three numbers and one, is
    zero; `number` among others.

    With `own_axes` it sees in axes of its own, x away from the arena's axis, so that a game that is
    turned looks the same.
    """
    inputs = {"pursuer": _PURSUER, "pillar": _PILLAR, "own": _OWN + 3 * WIDTH, "hidden": WIDTH}
    layers = {
        # no orthogonal ones: several decompositions at once may wait for each other for ever on a
        # CPU of two cores
        name: {
            "kernel": jax.nn.initializers.he_normal()(own, (size, WIDTH)),
            "bias": jnp.zeros(WIDTH),
        }
        for (name, size), own in zip(
            inputs.items(), jax.random.split(key, len(inputs)), strict=True
        )
    }
    return {
        **layers,
        "output": {"kernel": jnp.zeros((WIDTH, 4)), "bias": jnp.zeros(4)},
        # these three go with them, and have no gradient
        "look_ahead": jnp.asarray(LOOK_AHEAD)[number % len(LOOK_AHEAD)],
        # every third starts as a greedy evader, a local optimum that others find no way out of
        "scripted": jnp.float32(number % 3 == 2),
        "own_axes": jnp.float32(own_axes),
    }


def features(
    networks: dict[str, Any], which: int | Count, scene: Scene, memory: Memory
) -> dict[str, jax.Array]:
    """What the one of K networks that `which` () names sees: own (9,), pursuers (N, 10), pillars
    (P, 4), in_use (P,), greedy (3,), outward (2,), and active (N,) where slots may be empty.
    """
    settings = scene.settings
    scene = scene.replace(look_ahead=networks["look_ahead"][which])
    before = memory[MEMORY:].reshape(STEPS, *scene.pursuers.shape)
    relative = scene.pursuers - scene.position
    distance = jnp.sqrt(jnp.sum(relative**2, axis=-1, keepdims=True) + 1e-12)
    half = scene.pursuers - before[STEPS // 2]
    whole = scene.pursuers - before[0]
    scale = settings.max_speed * settings.time_step * STEPS
    to_pillar = scene.pillar_position - scene.position[:2]
    gap = jnp.sqrt(jnp.sum(to_pillar**2, axis=-1, keepdims=True) + 1e-12)
    in_use = scene.pillar_active[:, None]
    size = np.array([settings.arena_radius] * 2 + [settings.arena_height / 2], np.float32)
    middle = np.array(settings.middle, np.float32)
    wish = networks["scripted"][which] * greedy(scene, memory)[0]
    outward = scene.position[:2] / jnp.sqrt(jnp.sum(scene.position[:2] ** 2) + 1e-6)
    outward = jnp.where(networks["own_axes"][which] > 0, outward, np.array([1.0, 0.0], np.float32))
    own = functools.partial(turned_back, outward)
    vectors = (
        own((scene.position - middle) / size),
        own(scene.velocity / settings.evader_speed),
        own(wish),
    )
    flown = [own(scene.pursuer_velocity / settings.max_speed), own(scene.thrust_direction)]
    moved = [own(relative), distance, own(2.0 * half / scale), own(whole / scale), *flown]
    seen = {
        "own": jnp.concatenate(vectors),
        "pursuers": jnp.concatenate(moved, axis=-1),
        "pillars": jnp.where(in_use, jnp.concatenate([own(to_pillar), gap, in_use], axis=-1), 0.0),
        "in_use": scene.pillar_active,
        "greedy": wish,
        "outward": outward,
    }
    if scene.active is not None:
        seen["pursuers"] = of_team(scene.active, seen["pursuers"])
        seen["active"] = scene.active
    # fused with what follows, the greedy evader in it takes a GPU's compiler minutes
    return jax.lax.optimization_barrier(seen)


def outputs(
    network: dict[str, Any], seen: dict[str, jax.Array]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch"]]:
    """Mean wish (..., 3) and value (...,) for features with leading axes."""

    def dense(name, x):
        return x @ network[name]["kernel"] + network[name]["bias"]

    pursuers = jnp.tanh(dense("pursuer", seen["pursuers"]))
    pillars = jnp.where(seen["in_use"][..., None], jnp.tanh(dense("pillar", seen["pillars"])), 0.0)
    if "active" in seen:
        active = seen["active"][..., None]
        mean = jnp.sum(active * pursuers, axis=-2) / jnp.maximum(jnp.sum(active, axis=-2), 1)
        most = jnp.max(jnp.where(active, pursuers, -1.0), axis=-2)  # a tanh's least
    else:
        mean, most = jnp.mean(pursuers, axis=-2), jnp.max(pursuers, axis=-2)
    pooled = [mean, most, jnp.sum(pillars, axis=-2)]
    hidden = jnp.tanh(dense("own", jnp.concatenate([seen["own"], *pooled], axis=-1)))
    out = dense("output", jnp.tanh(dense("hidden", hidden)))
    inverse = seen["outward"] * np.array([1.0, -1.0], np.float32)
    return seen["greedy"] + turned_back(inverse, out[..., :3]), out[..., 3]


def remember(scene: Scene, memory: Memory) -> Memory:
    """The memory after this step."""
    return jnp.concatenate(
        [memory[:MEMORY], memory[MEMORY + scene.pursuers.size :], scene.pursuers.ravel()]
    )


def outputs_of(
    networks: dict[str, Any], which: Int32[Array, "*batch"], seen: dict[str, jax.Array]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch"]]:
    """`outputs` of the one of K networks, every leaf with their axis first, that `which` (...)
    names for each of the features.
    """
    # all of them: cheaper than their parameters by world
    wishes, values = jax.vmap(outputs, (0, None))(networks, seen)
    chosen = jax.nn.one_hot(which, values.shape[0], axis=0)
    return jnp.sum(chosen[..., None] * wishes, axis=0), jnp.sum(chosen * values, axis=0)


def learning(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """The behaviour without a network, whose wishes come from outside: the greedy one's, and the
    memory goes on.
    """
    return greedy(scene, memory)[0], remember(scene, memory)
