"""The assumed place of an evader that nobody sees: where it was last seen, or the nearest place to
that where it can be.

Pursuers know the pillars and one another, so they know what they see: an evader that
was last seen at a place in full view isn't there. What all of them leave hidden is some
two hundredths of the arena, and the nearest part of it is nearly always where it is. A
policy has no memory of its own: it can't know that it has looked already.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.sensing import is_open, line_of_sight, within_view
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Vector, Which
from openjax.pursuit.task import Task
from openjax.vehicle import DroneState

ANGLES = 12
"""Places that are looked at round where it was thought to be, on each of the
circles.
"""
STRIDES = (0.05, 0.12, 0.25)
"""How far they are from there (m). It can't jump to another pillar; with these it is
.10 m (level) from where it's taken to be one to eight seconds after it was seen, in the
mean of two policies' flights, and .15 to .29 m from where it was last seen.
"""


def thought_place(
    settings: PursuitSettings,
    task: Task,
    seen_drones: DroneState,
    active: Which | None,
    place: Vector,
) -> Vector:
    """(3,) m, where the evader is taken to be while nobody sees it, that was thought to
    be at (3,) `place`: there, or with `settings.track_unseen` where it can be.
    """
    if not settings.track_unseen:
        return place
    # who hasn't seen it yet knows of no place
    was_seen = jnp.any(place != jnp.array(settings.middle, jnp.float32))
    hiding_place = nearest_hidden(settings, task, seen_drones, active, place)
    return jnp.where(was_seen, hiding_place, place)


def nearest_hidden(
    settings: PursuitSettings, task: Task, drones: DroneState, active: Which | None, thought: Vector
) -> Vector:
    """(3,) m, where an evader can be that was thought to be at (3,) and isn't seen by N
    drones: there, if that place is hidden, or at the nearest of the places round it
    that is, at its height; there, too, where none of them is hidden.

    `active` (N,) says which slots of pursuers are in use, None: all are.
    """
    offset = _offsets()
    # which place it is has no gradient, and that of an index is a scatter
    place = jax.lax.stop_gradient(thought) + offset
    # all are at its height, which is one that it can have
    free = is_open(settings, place, task.pillar_position, task.pillar_active)
    is_hidden = free & ~_is_seen(settings, task, drones, active, place)
    distance = jnp.where(is_hidden, np.linalg.norm(offset, axis=-1), jnp.inf)
    # the first of equals, so the place itself where nothing is hidden
    return place[jnp.argmin(distance)]


def _offsets() -> Float[np.ndarray, "places 3"]:
    """(M, 3) m, none first, then level ones."""
    angle = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    way = np.stack([np.cos(angle), np.sin(angle), np.zeros(ANGLES)], axis=-1)
    level = np.array(STRIDES)[:, None, None] * way
    return np.concatenate([np.zeros((1, 3)), level.reshape(-1, 3)]).astype(np.float32)


def _is_seen(settings, task, drones, active, place) -> Bool[Array, " places"]:
    """(M,) which of (M, 3) places some of the drones sees."""
    position = drones.position
    ahead = rotation_axes(drones.quaternion)[0]

    def of_one(place):
        sees = line_of_sight(settings, position, place, task.pillar_position, task.pillar_active)
        if settings.limited_sight:
            sees &= within_view(settings, position, ahead, place)
        return jnp.any(sees if active is None else sees & active)

    return jax.vmap(of_one)(place)
