"""Breaches of safety distances and arena bounds, and crashes."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Active, Each, Pillars, Team, Which
from openjax.vehicle.solids import DRONE_RADIUS
from openjax.vehicle.vectors import length

TOUCH = 1e-3
"""A gap between solids below this (m) counts as touching: contacts are soft by a
fraction of it.
"""


@struct.dataclass
class Breaches:
    """Number of breaches of each pursuer in one step."""

    pillar: jax.Array  # (N,) float, pillars whose surface is too close
    drone: jax.Array  # (N,) float, other drones too close
    bounds: jax.Array  # (N,) float, above the ceiling, outside the wall

    @property
    def total(self) -> jax.Array:
        """(N,) all breaches of each pursuer."""
        return self.pillar + self.drone + self.bounds


def pillar_distance(
    settings: PursuitSettings, position: Team, pillar_position: Pillars
) -> Float[Array, "drones pillars"]:
    """(N, P) distance (m) between (N, 3) centres and the surfaces of (P, 2) pillars."""
    offset = position[:, None, :2] - pillar_position[None]
    # on the axis, too, with a finite gradient: see `length`
    return length(offset) - settings.pillar_radius


def drone_distance(position: Team) -> Float[Array, "drones drones"]:
    """(N, N) distance (m) between (N, 3) centres; infinite on the diagonal."""
    n = position.shape[0]
    offset = position[:, None] - position[None]
    distance = length(offset)
    return jnp.where(jnp.eye(n, dtype=bool), jnp.inf, distance)


def breaches(
    settings: PursuitSettings,
    position: Team,
    pillar_position: Pillars,
    pillar_active: Active,
    margin: float = 0.0,
) -> Breaches:
    """Count the breaches of each of N pursuers at (N, 3) positions; `margin` (m) widens
    every limit.
    """
    to_pillar = pillar_distance(settings, position, pillar_position)
    near_pillar = pillar_active[None] & (to_pillar < settings.pillar_clearance + margin)
    near_drone = drone_distance(position) < settings.drone_clearance + margin
    # the floor is none of these bounds: touching it is a crash
    above = position[:, 2] > settings.arena_height - margin
    outside = jnp.sum(position[:, :2] ** 2, axis=-1) > (settings.arena_radius - margin) ** 2
    return Breaches(
        pillar=jnp.sum(near_pillar, axis=-1).astype(jnp.float32),
        drone=jnp.sum(near_drone, axis=-1).astype(jnp.float32),
        bounds=above.astype(jnp.float32) + outside.astype(jnp.float32),
    )


def crashed(
    settings: PursuitSettings,
    position: Team,
    body_z_up: Each,
    pillar_position: Pillars,
    pillar_active: Active,
    margin: float = 0.0,
) -> Which:
    """(N,) whether each pursuer touches the floor or anything solid, or is tilted
    beyond 90 degrees.

    `body_z_up` (N,) is the world z component of the body's z axis. `margin` widens
    every limit (m; and the cosine).
    """
    reach = DRONE_RADIUS + TOUCH + margin
    on_floor = position[:, 2] < reach
    on_pillar = jnp.any(
        pillar_active & (pillar_distance(settings, position, pillar_position) < reach), axis=-1
    )
    # two radii, but one touch and one margin
    on_drone = jnp.any(drone_distance(position) < DRONE_RADIUS + reach, axis=-1)
    return on_floor | on_pillar | on_drone | (body_z_up < margin)
