"""Angelani (2012), Collective predation and escape strategies, Physical Review Letters
109, 118104.

Self-propelled particles of constant speed, drawn to the nearest prey, aligned with
their own kind and kept apart from it by a repulsion that a Fermi function switches on
at close range. Its plane has neither walls nor obstacles: here they repel as another
predator does.
"""

import jax
import jax.numpy as jnp
from flax import struct

from openjax.baselines.parameters import parameter
from openjax.baselines.surroundings import Craft, Surroundings, level, upward
from openjax.vehicle import vectors
from openjax.vehicle.vectors import unit


@struct.dataclass
class AngelaniParameters:
    """Weights are relative to the attraction's, which is 1."""

    alignment: jax.Array = parameter(1.0, 0.01, 2.0)
    """Weight of the team's mean direction of flight."""
    repulsion: jax.Array = parameter(1.0, 0.1, 10.0)
    """Weight of the repulsion between pursuers."""
    repulsion_range: jax.Array = parameter(0.3, 0.1, 1.0)
    """Distance at which that is half of its weight (m)."""
    width: jax.Array = parameter(0.045, 0.005, 0.2)
    """Over which the Fermi functions fall (m); .15 of the range in the source."""
    obstacle: jax.Array = parameter(1.0, 0.3, 30.0)
    """Weight of the repulsion from pillars and bounds (not in the source)."""
    obstacle_range: jax.Array = parameter(0.15, 0.03, 0.4)
    """Distance from their surface at which that is half of its weight (m)."""


def angelani(craft: Craft, parameters: AngelaniParameters, around: Surroundings) -> jax.Array:
    """Desired velocities (..., N, 3), m/s, world.

    v = v_max N[N(r_e - r_i) + w_a N(sum_j v_j) + w_r sum_j N(r_i - r_j) / (1 +
    exp((d_ij - r_r) / s)) + obstacles], N(x) = x / |x|.
    """

    def fermi(distance, middle):
        return jax.nn.sigmoid((middle - distance) / parameters.width)

    distance = vectors.length(around.from_others)
    repulsion = fermi(distance, parameters.repulsion_range)[..., None] * unit(around.from_others)

    nearness = fermi(around.obstacle_distance, parameters.obstacle_range)
    sideways = jnp.sum(nearness[..., None] * around.obstacle_normal, axis=-2)
    # the floor pushes up, the ceiling down
    from_floor = fermi(around.floor_distance, parameters.obstacle_range)
    from_ceiling = fermi(around.ceiling_distance, parameters.obstacle_range)
    obstacles = level(sideways) + upward(from_floor - from_ceiling)

    force = (
        unit(around.target - around.position)
        + parameters.alignment * unit(around.team_velocity)
        + parameters.repulsion * jnp.sum(repulsion, axis=-2)
        + parameters.obstacle * obstacles
    )
    # particles of constant speed: forces turn them, and never slow them down
    return craft.speed * unit(force)
