"""Janosov, Virágh, Vásárhelyi and Vicsek (2017), Group chasing tactics: how to catch a
faster prey, NJP 19, 053003.

Chasers fly to where the prey will be, damped by their relative velocity, spread out by
a long repulsion among themselves, avoid each other at close range, and are turned round
by soft walls: those of the arena there, and here pillars, floor and ceiling as well.
"""

import jax
import jax.numpy as jnp
from flax import struct

from openjax.baselines.parameters import parameter
from openjax.baselines.surroundings import Craft, Surroundings, length, level, upward
from openjax.vehicle.vectors import unit


@struct.dataclass
class JanosovParameters:
    """Names as in the source, which has a much larger arena; so ranges are searched."""

    prediction_time: jax.Array = parameter(0.5, 0.02, 2.0)
    """tau_pred: the prey is expected to fly straight for that long at most (s)."""
    chase_friction: jax.Array = parameter(0.1, 0.001, 1.0)
    """C_f of the chase: weight of the velocity relative to the prey over the squared
    distance (m s).
    """
    interaction: jax.Array = parameter(0.8, 0.01, 3.0)
    """C_inter: the long repulsion's share of the speed."""
    interaction_range: jax.Array = parameter(1.0, 0.2, 2.0)
    """r_inter: distance below which chasers spread (m)."""
    interaction_friction: jax.Array = parameter(0.5, 0.001, 1.0)
    """C_f of the interaction (m s)."""
    avoidance_range: jax.Array = parameter(0.25, 0.1, 0.5)
    """r_cd: distance below which chasers avoid each other at full speed (m)."""
    wall_range: jax.Array = parameter(0.2, 0.05, 0.5)
    """r_wall: distance from a surface over which a wall's repulsion rises to its full
    size (m).
    """
    wall: jax.Array = parameter(1.3, 0.5, 10.0)
    """That size in units of the speed; the prey's over the chasers' in the source."""


def janosov(craft: Craft, parameters: JanosovParameters, around: Surroundings) -> jax.Array:
    """Desired velocities (..., N, 3), m/s, world: the sum of the terms, cut at the
    largest speed.
    """
    to_target = around.target - around.position
    # no farther ahead than the prey could come here itself
    coming = length(to_target) / jnp.maximum(length(around.target_velocity), 1e-3)
    ahead = jnp.minimum(parameters.prediction_time, coming)
    prediction = around.target + ahead * around.target_velocity
    relative = around.velocity - around.target_velocity
    # a prey that isn't seen has no velocity to be damped against
    is_seen = jnp.any(around.target_velocity != 0.0, axis=-1, keepdims=True)
    friction = jnp.where(is_seen, relative / jnp.maximum(length(to_target) ** 2, 1e-4), 0.0)
    chase = unit(unit(prediction - around.position) - parameters.chase_friction * friction)

    distance = length(around.from_others)
    away = around.from_others / distance
    spread = away * jnp.maximum(parameters.interaction_range - distance, 0.0)
    spread = spread - parameters.interaction_friction * around.from_others_velocity / distance**2
    within = distance < parameters.interaction_range
    spread = jnp.sum(jnp.where(within, spread, 0.0), axis=-2)
    avoidance = jnp.sum(away * jnp.maximum(parameters.avoidance_range - distance, 0.0), axis=-2)

    def soft_wall(gap):
        """0 from `wall_range` on, 1 at the surface, a half sine between (equation
        6).
        """
        return 0.5 + 0.5 * jnp.cos(jnp.pi * jnp.clip(gap / parameters.wall_range, 0.0, 1.0))

    nearness = soft_wall(around.obstacle_distance)
    sideways = jnp.sum(nearness[..., None] * around.obstacle_normal, axis=-2)
    # the floor pushes up, the ceiling down
    vertical = soft_wall(around.floor_distance) - soft_wall(around.ceiling_distance)
    walls = level(sideways) + upward(vertical)
    terms = (
        chase + parameters.interaction * unit(spread) + unit(avoidance) + parameters.wall * walls
    )
    # cut, not normalised: a chaser whose terms cancel hovers
    return craft.speed * terms / jnp.maximum(length(terms), 1.0)
