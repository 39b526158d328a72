"""Line of sight to the evader, past the pillars, within range and cone; a team shares it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Active, Pillars, Vector
from openjax.vehicle.vectors import length


def line_of_sight(
    settings: PursuitSettings,
    position: Float[Array, "places 3"],
    target: Vector,
    pillar_position: Pillars,
    pillar_active: Active,
) -> Bool[Array, " places"]:
    """(N,) whether the segment from each (N, 3) position to the (3,) target is clear of
    pillars, seen from above.

    A pillar blocks it if its axis is closer to the segment than its radius and the foot
    point lies on the segment.
    """
    square, between = _from_axes(position, target, pillar_position, pillar_active)
    return ~jnp.any(between & (square < settings.pillar_radius**2), axis=-1)


def is_open(
    settings: PursuitSettings,
    place: Float[Array, "*places dims"],
    pillar_position: Pillars,
    pillar_active: Active,
) -> Bool[Array, "*places"]:
    """(...) whether (..., 2 or 3) places are inside the arena's circle and outside all
    pillars, seen from above.
    """
    level = place[..., :2]
    to_axis = jnp.sum((level[..., None, :] - pillar_position) ** 2, axis=-1)
    in_pillar = pillar_active & (to_axis < settings.pillar_radius**2)
    in_arena = jnp.sum(level**2, axis=-1) < settings.arena_radius**2
    return in_arena & ~jnp.any(in_pillar, axis=-1)


def sight_room(
    settings: PursuitSettings,
    position: Float[Array, "places 3"],
    target: Vector,
    pillar_position: Pillars,
    pillar_active: Active,
) -> Float[Array, " places"]:
    """(N,) m, how far the segment from each (N, 3) position to the (3,) target passes
    the surface of the pillars between them: negative where it is blocked, a pillar's
    radius at most.
    """
    square, between = _from_axes(position, target, pillar_position, pillar_active)
    # the small number keeps the root's gradient finite on a pillar's axis
    room = jnp.sqrt(square + 1e-12) - settings.pillar_radius
    return jnp.min(room, axis=-1, where=between, initial=settings.pillar_radius)


def _from_axes(position, target, pillar_position, pillar_active):
    """(N, P) m², squares of how far pillars' axes are from the lines to the target,
    from above: pillars are as high as the arena; (N, P) which of the pillars stand
    between.
    """
    start = position[:, None, :2]
    segment = target[None, None, :2] - start
    to_axis = pillar_position[None] - start
    length_squared = jnp.sum(segment**2, axis=-1)
    along = jnp.sum(to_axis * segment, axis=-1) / jnp.maximum(length_squared, 1e-12)
    across = to_axis - along[..., None] * segment
    between = pillar_active[None] & (along >= 0.0) & (along <= 1.0)
    return jnp.sum(across**2, axis=-1), between


def within_view(
    settings: PursuitSettings,
    position: Float[Array, "places 3"],
    ahead: Float[Array, "places 3"],
    target: Vector,
) -> Bool[Array, " places"]:
    """(N,) whether the (3,) target is within `sight_range` of each (N, 3) position and
    within the cone of `sight_angle` about each axis (N, 3), of length one.
    """
    offset = target - position
    distance = length(offset)
    # a whole turn is everywhere, what lies exactly behind included
    least = np.cos(np.deg2rad(settings.sight_angle) / 2) if settings.sight_angle < 360.0 else -2.0
    in_cone = jnp.sum(offset * ahead, axis=-1) >= least * distance
    return (distance <= settings.sight_range) & in_cone
