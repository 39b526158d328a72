"""A learned evader: a small network with a memory; every third is added to what the
greedy evader of some look-ahead would do.

Its memory holds where the pursuers were in the last steps. Pursuers and pillars are
pooled, so that their number and order don't matter. With zeros in its last layer, as it
starts, it is that greedy evader, or stays where it is.
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
from openjax.vehicle.vectors import length

STEPS = 10
"""Steps that it remembers."""
WIDTH = 64
"""Units of each hidden layer."""
LOOK_AHEAD = (0.15, 0.5, 0.3)
"""Seconds that the greedy evaders look ahead as which networks start, one after the
other: a best response to who is caught out by a far-sighted one isn't found from a
short-sighted one.
"""
_OWN = 9
"""Numbers of `features` that an evader knows of itself: place, velocity, greedy wish (3
each).
"""
_PURSUER = 16
"""And of each pursuer: offset, two moves, velocity, thrust direction (3 each),
distance.
"""
_PILLAR = 4
"""And of each pillar: offset (2), distance, in use."""


def learned_place(names: tuple[str, ...], kind: Int32[Array, "*worlds"]) -> Int32[Array, "*worlds"]:
    """The place among the learned evaders of those at the places `kind` (...) in
    `names`; -1 for others.
    """
    is_learned = np.array([EVADERS[name].behaviour == "learned" for name in names])
    return jnp.asarray(np.where(is_learned, np.cumsum(is_learned) - 1, -1))[kind]


def init_network(
    key: PRNGKeyArray, number: int | Count = 0, own_axes: bool = False
) -> dict[str, Any]:
    """Parameters of a network (actor and critic alike) whose output, three numbers and
    one, is zero; `number` among others.

    With `own_axes` it sees in axes of its own, x away from the arena's axis, so that a
    game that is turned looks the same.
    """
    inputs = {"pursuer": _PURSUER, "pillar": _PILLAR, "own": _OWN + 3 * WIDTH, "hidden": WIDTH}
    # no orthogonal ones: several decompositions at once may wait for each other for
    # ever on a CPU of two cores
    initial = jax.nn.initializers.he_normal()
    keys = jax.random.split(key, len(inputs))
    layers = {
        name: {"kernel": initial(layer_key, (size, WIDTH)), "bias": jnp.zeros(WIDTH)}
        for (name, size), layer_key in zip(inputs.items(), keys, strict=True)
    }
    return {
        **layers,
        "output": {"kernel": jnp.zeros((WIDTH, 4)), "bias": jnp.zeros(4)},
        # these three go with them, and have no gradient
        "look_ahead": jnp.asarray(LOOK_AHEAD)[number % len(LOOK_AHEAD)],
        # every third starts as a greedy evader, a local optimum that others find no way
        # out of
        "scripted": jnp.float32(number % 3 == 2),
        "own_axes": jnp.float32(own_axes),
    }


def features(
    networks: dict[str, Any], which: int | Count, scene: Scene, memory: Memory
) -> dict[str, jax.Array]:
    """The inputs of the one of K networks that `which` () names: own (9,), pursuers (N, 16),
    pillars (P, 4), in_use (P,), greedy (3,), outward (2,), and active (N,) where slots may be
    empty.

    Of itself: place in the arena, velocity, the greedy wish. Of each pursuer: offset
    and distance, how it moved over the last half and the whole of the memory, its
    velocity, where its rotors pull. Of each pillar: offset, distance, and whether the
    slot is in use.
    """
    settings = scene.settings
    scene = scene.replace(look_ahead=networks["look_ahead"][which])
    # so that all inputs are of the order of one
    radius = jnp.float32(settings.arena_radius)
    size = jnp.stack([radius, radius, settings.arena_height / 2])
    middle = np.array(settings.middle, np.float32)
    wish = networks["scripted"][which] * greedy(scene, memory)[0]
    outward = scene.position[:2] / jnp.sqrt(jnp.sum(scene.position[:2] ** 2) + 1e-6)
    outward = jnp.where(networks["own_axes"][which] > 0, outward, np.array([1.0, 0.0], np.float32))
    turn_back = functools.partial(turned_back, outward)
    itself = [
        turn_back((scene.position - middle) / size),
        turn_back(scene.velocity / settings.evader_speed),
        turn_back(wish),
    ]
    parts = {
        "own": jnp.concatenate(itself),
        "pursuers": _pursuer_features(scene, memory, turn_back),
        "pillars": _pillar_features(scene, turn_back),
        "in_use": scene.pillar_active,
        "greedy": wish,
        "outward": outward,
    }
    if scene.active is not None:
        parts["pursuers"] = of_team(scene.active, parts["pursuers"])
        parts["active"] = scene.active
    # fused with what follows, the greedy evader in it takes a GPU's compiler minutes
    return jax.lax.optimization_barrier(parts)


def _pursuer_features(scene, memory, turn_back):
    """(N, 16) of the pursuers; `turn_back` turns vectors into the network's axes."""
    settings = scene.settings
    earlier = memory[MEMORY:].reshape(STEPS, *scene.pursuers.shape)  # oldest first
    offset = scene.pursuers - scene.position
    distance = length(offset, keepdims=True)
    # as far as a pursuer gets in the memory's time: what it moved is of the order of
    # one
    scale = settings.max_speed * settings.time_step * STEPS
    numbers = [
        turn_back(offset),
        distance,
        turn_back(2.0 * (scene.pursuers - earlier[STEPS // 2]) / scale),
        turn_back((scene.pursuers - earlier[0]) / scale),
        turn_back(scene.pursuer_velocity / settings.max_speed),
        turn_back(scene.thrust_direction),
    ]
    return jnp.concatenate(numbers, axis=-1)


def _pillar_features(scene, turn_back):
    """(P, 4) of the pillars, zeros in slots that aren't in use."""
    offset = scene.pillar_position - scene.position[:2]
    distance = length(offset, keepdims=True)
    in_use = scene.pillar_active[:, None]
    return jnp.where(in_use, jnp.concatenate([turn_back(offset), distance, in_use], axis=-1), 0.0)


def outputs(
    network: dict[str, Any], inputs: dict[str, jax.Array]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch"]]:
    """Mean wish (..., 3) and value (...,) for `features` with leading axes."""

    def dense(name, x):
        return x @ network[name]["kernel"] + network[name]["bias"]

    pursuers = jnp.tanh(dense("pursuer", inputs["pursuers"]))
    pillars = jnp.tanh(dense("pillar", inputs["pillars"]))
    pillars = jnp.where(inputs["in_use"][..., None], pillars, 0.0)
    if "active" in inputs:
        active = inputs["active"][..., None]
        mean = jnp.sum(active * pursuers, axis=-2) / jnp.maximum(jnp.sum(active, axis=-2), 1)
        most = jnp.max(jnp.where(active, pursuers, -1.0), axis=-2)  # a tanh's least
    else:
        mean = jnp.mean(pursuers, axis=-2)
        most = jnp.max(pursuers, axis=-2)
    # pursuers by mean and maximum, whose size doesn't grow with their number; pillars
    # by a sum, as empty slots are zeros
    sums = [mean, most, jnp.sum(pillars, axis=-2)]
    features = jnp.tanh(dense("own", jnp.concatenate([inputs["own"], *sums], axis=-1)))
    out = dense("output", jnp.tanh(dense("hidden", features)))
    # from its own axes into the world's: the same yaw with the other sign
    inverse = inputs["outward"] * np.array([1.0, -1.0], np.float32)
    return inputs["greedy"] + turned_back(inverse, out[..., :3]), out[..., 3]


def remember(scene: Scene, memory: Memory) -> Memory:
    """The memory after this step."""
    return jnp.concatenate(
        [memory[:MEMORY], memory[MEMORY + scene.pursuers.size :], scene.pursuers.ravel()]
    )


def outputs_of(
    networks: dict[str, Any], which: Int32[Array, "*batch"], inputs: dict[str, jax.Array]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch"]]:
    """`outputs` of the one of K networks, every leaf with their axis first, that
    `which` (...) names for each of the features.
    """
    # all of them: cheaper than their parameters by world
    wishes, values = jax.vmap(outputs, (0, None))(networks, inputs)
    one_hot = jax.nn.one_hot(which, values.shape[0], axis=0)
    return jnp.sum(one_hot[..., None] * wishes, axis=0), jnp.sum(one_hot * values, axis=0)


def learning(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """The behaviour without a network, whose wishes come from outside: the greedy
    one's, and the memory goes on.
    """
    return greedy(scene, memory)[0], remember(scene, memory)
