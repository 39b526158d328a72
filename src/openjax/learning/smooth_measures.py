"""What pursuers meet in flight, as smooth numbers: how near a crash is, a breach, the
evader.

A crash or a capture is a step, which has no gradient. Here each goes from none to whole
over a distance, so that the actor feels it before it comes.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from openjax.pursuit import PursuitSettings, PursuitState
from openjax.pursuit.collisions import TOUCH, drone_distance, pillar_distance
from openjax.pursuit.sensing import sight_room
from openjax.pursuit.shortest_paths import ShortestPaths, evader_territory, path_length
from openjax.pursuit.task import arena_of
from openjax.vehicle import DroneState
from openjax.vehicle.solids import DRONE_RADIUS
from openjax.vehicle.vectors import length

Worlds = Float[Array, "worlds"]
"""A number of each world."""
Pursuers = Float[Array, "worlds pursuers"]
"""A number of each pursuer of each world."""

SMOOTH = 0.012
"""Distance (m) over which a crash goes from sure to none in what is learnt: gaps
between pillars of a row aren't wide. First flights feel it from farther
(`crash_smooth`).
"""
SMOOTH_BREACH = 0.008
"""The same for a breach of a safety distance or a bound (m)."""
SMOOTH_TILT = 0.05
"""The same for a tip over 90 degrees (cosine of the tilt)."""
SMOOTH_CAPTURE = 0.1
"""The same for a capture (m)."""
SMOOTH_NEAREST = 0.15
"""The same for which pursuer is nearest to the evader (m)."""
SMOOTH_SIGHT = 0.05
"""The same for whether a line of sight passes a pillar (m)."""
FAST = 0.05
"""Speed (m/s) above where the speed begins to cost that costs as much as a crash in
every step would.
"""


def nearest_gap(game: PursuitSettings, state: PursuitState) -> Pursuers:
    """(W, N) m, from each pursuer of worlds (W, ...) to the nearest solid thing:
    pillar, pursuer or floor.
    """
    position = state.drones.position
    task = state.task
    to_pillar = jax.vmap(lambda p, q: pillar_distance(game, p, q))(position, task.pillar_position)
    active = task.pillar_active[:, None]
    gap = jnp.min(to_pillar, axis=-1, where=active, initial=jnp.inf) - DRONE_RADIUS
    if game.num_pursuers > 1:
        others = jnp.min(jax.vmap(drone_distance)(position), axis=-1)
        gap = jnp.minimum(gap, others - 2 * DRONE_RADIUS)
    return jnp.minimum(gap, position[..., 2] - DRONE_RADIUS)


def crash_share(gap: Float[Array, "*worlds"], smooth: float = SMOOTH) -> Float[Array, "*worlds"]:
    """How much of a crash a least gap (m) counts as, from 1 to 0 over `smooth` (m): it
    has a gradient before a touch.
    """
    # half of one at three times the gap that counts as a touch
    return jax.nn.sigmoid((3 * TOUCH - gap) / smooth)


def crash_depth(gap: Float[Array, "*worlds"]) -> Float[Array, "*worlds"]:
    """The same that goes on to grow, by 1 every `SMOOTH`: what would crash by far is
    learnt from, too.
    """
    return jax.nn.softplus((3 * TOUCH - gap) / SMOOTH)


def tip_share(upright: Float[Array, "*worlds"]) -> Float[Array, "*worlds"]:
    """The same of a least cosine of the tilt."""
    return jax.nn.sigmoid((2 * SMOOTH_TILT - upright) / SMOOTH_TILT)


def breach_share(game: PursuitSettings, state: PursuitState) -> Pursuers:
    """(W, N) smooth number of breaches of each pursuer in worlds (W, ...);
    `openjax.pursuit.collisions.breaches`.
    """
    position = state.drones.position
    task = state.task
    to_pillar = jax.vmap(lambda p, q: pillar_distance(game, p, q))(position, task.pillar_position)
    to_pillar = jnp.where(task.pillar_active[:, None], to_pillar, jnp.inf) - game.pillar_clearance
    to_drone = jax.vmap(drone_distance)(position) - game.drone_clearance
    radius = arena_of(game, task).arena_radius
    to_wall = jnp.expand_dims(radius, -1) - length(position[..., :2])
    to_ceiling = game.arena_height - position[..., 2]

    def near(distance):
        return jax.nn.sigmoid((SMOOTH_BREACH - distance) / SMOOTH_BREACH)

    total = jnp.sum(near(to_pillar), axis=-1) + jnp.sum(near(to_drone), axis=-1)
    total = total + near(to_wall) + near(to_ceiling)
    return total if state.active is None else jnp.where(state.active, total, 0.0)


def evader_distance(game: PursuitSettings, state: PursuitState, paths: ShortestPaths) -> Pursuers:
    """(W, N) m, shortest paths from pursuers of worlds (W, ...) to the evader, whose
    flight has no gradient: its answers are a cliff.
    """
    evader = jax.lax.stop_gradient(state.evader_position)
    return jax.vmap(functools.partial(path_length, game))(
        state.task, paths, state.drones.position, evader
    )


def territory_share(game: PursuitSettings, state: PursuitState, paths: ShortestPaths) -> Worlds:
    """(W,) share of the arena that the evader of worlds (W, ...) can be at before any
    pursuer; its flight has no gradient.
    """

    def one(state, paths):
        evader = jax.lax.stop_gradient(state.evader_position)
        return evader_territory(game, state.task, paths, state.drones.position, evader)

    return jax.vmap(one)(state, paths)


def hidden_share(game: PursuitSettings, state: PursuitState) -> Worlds:
    """(W,) how well pillars hide the evader of worlds (W, ...) from all pursuers, from
    0 to 1; its flight has no gradient.
    """

    def one(state):
        task = state.task
        target = jax.lax.stop_gradient(state.evader_position)
        room = sight_room(
            game, state.drones.position, target, task.pillar_position, task.pillar_active
        )
        if state.active is not None:
            # who is parked sees it past all pillars
            room = jnp.where(state.active, room, -jnp.inf)
        return jax.nn.sigmoid(-jnp.max(room) / SMOOTH_SIGHT)

    return jax.vmap(one)(state)


def nearest_distance(distance: Pursuers) -> Worlds:
    """(W,) m, a smooth least of distances (W, N): where one pursuer is near, others
    needn't be, and may go round.
    """
    # less the logarithm of their number: of equal distances it is that distance
    number = distance.shape[-1]
    soft = jax.nn.logsumexp(-distance / SMOOTH_NEAREST, axis=-1) - jnp.log(number)
    return -SMOOTH_NEAREST * soft


def free_share(radius: float | jax.Array, distance: Pursuers) -> Worlds:
    """(W,) how free the evader at distances (W, N) is, from 0 to 1: smooth, and felt
    from afar; capture radius () or (W,) m.
    """
    # half free a little inside the capture radius, so that pursuers come in all the way
    return jax.nn.sigmoid((jnp.min(distance, axis=-1) - 0.95 * radius) / SMOOTH_CAPTURE)


def speed(drones: DroneState) -> Pursuers:
    """(W, N) m/s."""
    # the small number keeps the root's gradient finite at rest
    return jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1) + 1e-9)
