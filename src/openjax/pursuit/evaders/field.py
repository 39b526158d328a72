"""The paper's evader: a potential field that flees pursuers in sight, pillars and the
arena's bounds.
"""

import jax
import jax.numpy as jnp

from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Active, Pillars, Team, Vector, Which
from openjax.vehicle.vectors import length

EPSILON = 1e-5
"""Added to distances (m) and their squares, so that nothing is divided by zero."""
INWARD = 1e5
"""Push back where the evader is outside the arena or inside a pillar: what 1/distance
comes to at `EPSILON`.
"""


def field_velocity(
    settings: PursuitSettings,
    evader: Vector,
    pursuers: Team,
    in_sight: Which,
    pillar_position: Pillars,
    pillar_active: Active,
) -> Vector:
    """(3,) velocity (m/s, world) of the evader at (3,), memoryless, of constant speed.

    `pursuers` (N, 3) repel as 1/distance where `in_sight` (N,); bounds and pillars as
    1/distance to their surface.
    """
    away = evader - pursuers
    # a unit vector over the distance is the offset over its square
    push = away / (_norm_squared(away) + EPSILON)
    force = jnp.sum(jnp.where(in_sight[:, None], push, 0.0), axis=0)

    radius = jnp.sqrt(_norm_squared(evader[:2])[0] + 1e-12)
    outward = evader[:2] / radius
    to_wall = settings.arena_radius - radius
    wall = -outward * jnp.where(to_wall > 0.0, 1.0 / (jnp.maximum(to_wall, 0.0) + EPSILON), INWARD)

    to_ceiling = settings.arena_height - evader[2]
    ceiling = jnp.where(to_ceiling > 0.0, 1.0 / (jnp.maximum(to_ceiling, 0.0) + EPSILON), INWARD)
    floor = jnp.where(evader[2] > 0.0, 1.0 / (jnp.maximum(evader[2], 0.0) + EPSILON), INWARD)

    from_pillar = evader[None, :2] - pillar_position
    distance = jnp.sqrt(_norm_squared(from_pillar) + 1e-12)
    to_surface = distance - settings.pillar_radius
    strength = jnp.where(to_surface > 0.0, 1.0 / (jnp.maximum(to_surface, 0.0) + EPSILON), INWARD)
    push = from_pillar / distance * strength
    pillars = jnp.sum(jnp.where(pillar_active[:, None], push, 0.0), axis=0)

    # pillars and wall push on the level alone, ceiling and floor upright
    force = force + jnp.concatenate([wall + pillars, (floor - ceiling)[None]])
    # the field says where to, never how fast
    size = length(force)
    return settings.evader_speed * force / (size + EPSILON)


def _norm_squared(vector: jax.Array) -> jax.Array:
    return jnp.sum(vector**2, axis=-1, keepdims=True)
