"""Artificial potential field with wall following, as in DACOOP (Zhang et al., 2022)
after Koren and Borenstein (1991).

Attraction to the evader, repulsion from obstacles, and between pursuers a force that
repels at close range and attracts at long. Where attraction and repulsion together
point away from the evader (the local minimum that Koren and Borenstein describe), the
pursuer flies along the obstacle instead.
"""

import jax
import jax.numpy as jnp
from flax import struct

from openjax.baselines.parameters import parameter
from openjax.baselines.surroundings import Craft, Surroundings, length, level, upward
from openjax.vehicle.vectors import unit

SAFE_PURSUER = 0.14
"""Distance between two pursuers at which their repulsion grows without bound (m): the
game's safety distance.
"""
NEAREST = 0.005
"""Distances beyond the safe ones are taken to be at least this (m), so that forces stay
finite.
"""


@struct.dataclass
class ApfParameters:
    """Forces are relative to the attraction, which is 1."""

    repulsion: jax.Array = parameter(1e-3, 1e-6, 0.03)
    """eta: scale of the obstacles' repulsion (m^3)."""
    influence: jax.Array = parameter(0.3, 0.05, 0.6)
    """rho: distance from a surface beyond which it doesn't repel (m)."""
    margin: jax.Array = parameter(0.14, 0.05, 0.25)
    """Distance from a surface at which its repulsion grows without bound (m); the
    robot's radius in the source.
    """
    balance: jax.Array = parameter(0.2, 0.003, 1.0)
    """lambda: of the force between pursuers, 1/2 - lambda / d: they keep 2 lambda apart
    (m).
    """


@struct.dataclass
class Forces:
    """The parts of the field, (..., N, 3) each, without unit."""

    attraction: jax.Array
    repulsion: jax.Array  # from pillars, wall, floor and ceiling
    individual: jax.Array  # mean over the other pursuers
    inside: jax.Array  # (..., N) bool, nearer to an obstacle than the margin


def forces(parameters: ApfParameters, around: Surroundings) -> Forces:
    """The field at each pursuer; parameters () or (..., N)."""

    def push(gap, eta, rho, margin):
        """eta (1/d - 1/rho) / d^2 of the distance beyond the margin."""
        d = jnp.maximum(gap - margin, NEAREST)
        return jnp.where(d < rho, eta * (1.0 / d - 1.0 / rho) / d**2, 0.0)

    eta = jnp.asarray(parameters.repulsion)
    rho = jnp.asarray(parameters.influence)
    margin = jnp.asarray(parameters.margin)
    # an axis more: each pursuer's parameters hold for all of its obstacles
    each = push(around.obstacle_distance, eta[..., None], rho[..., None], margin[..., None])
    from_floor = push(around.floor_distance, eta, rho, margin)
    from_ceiling = push(around.ceiling_distance, eta, rho, margin)

    distance = length(around.from_others)
    beyond = jnp.maximum(distance - SAFE_PURSUER, NEAREST)
    balance = jnp.asarray(parameters.balance)[..., None, None]
    pull = -around.from_others / distance * (0.5 - balance / beyond)
    sideways = jnp.sum(each[..., None] * around.obstacle_normal, axis=-2)
    return Forces(
        attraction=unit(around.target - around.position),
        repulsion=level(sideways) + upward(from_floor - from_ceiling),
        individual=jnp.sum(pull, axis=-2) / max(around.from_others.shape[-2], 1),
        inside=jnp.min(around.obstacle_distance, axis=-1) < parameters.margin,
    )


def apf(craft: Craft, parameters: ApfParameters, around: Surroundings) -> jax.Array:
    """Desired velocities (..., N, 3), m/s, world: along the field, or along an obstacle
    that is in the way.
    """
    field = forces(parameters, around)
    # without the force between pursuers: it alone never holds anybody in a local
    # minimum
    towards = field.attraction + field.repulsion
    is_blocked = jnp.sum(towards * field.attraction, axis=-1, keepdims=True) < 0.0
    along = wall_following(field, around.velocity)
    total = towards + field.individual
    return craft.speed * jnp.where(is_blocked, along, unit(total))


def wall_following(field: Forces, velocity: jax.Array) -> jax.Array:
    """(..., N, 3) unit vector at right angles to the obstacles' repulsion.

    The side is that to which the other pursuers push or, where they push less than the
    evader pulls, that to which the pursuer flies anyhow. Inside the margin it turns
    half away from the obstacle; its height is the field's.
    """
    away = unit(field.repulsion[..., :2])
    tangent = jnp.stack([-away[..., 1], away[..., 0]], axis=-1)
    # 1 is the size of the attraction
    is_pushed = length(field.individual) > 1.0
    heading = jnp.where(is_pushed, field.individual, unit(velocity))[..., :2]
    side = jnp.where(jnp.sum(tangent * heading, axis=-1, keepdims=True) >= 0.0, 1.0, -1.0)
    climb = field.attraction + field.repulsion + field.individual
    along = side * tangent + jnp.where(field.inside[..., None], away, 0.0)
    return unit(level(along) + upward(unit(climb)[..., 2]))
