"""Distances to the evader round the pillars: shortest paths in the plane, by a visibility graph.

A shortest path round discs is straight but for where it bends about one. Here the
discs, pillars with their safety distance, are polygons, and a path bends at their
corners (Lozano-Perez and Wesley 1979, An algorithm for planning collision-free paths).
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Each, Team, Vector
from openjax.pursuit.task import Task, arena_of

CORNERS = 6
"""Of the polygon about each pillar."""
ROOM = 0.03
"""How much farther from a pillar than the safety distance a path keeps (m). Nearer, the
shares of crashes and breaches that a first flight counts early cost more than a path
through saves: pursuers then stand before it.
"""
TOLL = 3.0
"""Cost of a path through a pillar (m): more than any path round."""


@struct.dataclass
class ShortestPaths:
    """The shortest paths of a task with P pillar slots, between the C = P * CORNERS
    corners.
    """

    corner: jax.Array  # (C, 2) m
    toll: jax.Array  # (C,) m
    """Of corners that no path may pass: outside the arena, in another pillar's reach,
    of no pillar.
    """
    length: jax.Array  # (C, C) m, of the shortest path from one to another


def shortest_paths(settings: PursuitSettings, task: Task) -> ShortestPaths:
    """All corners and the shortest paths between them."""
    settings = arena_of(settings, task)
    reach = _reach(settings)
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    # so far out that the edges between corners touch the circle, and a thousandth
    # beyond: an edge on the circle itself would count as crossing it
    radius = 1.001 * reach / np.cos(np.pi / CORNERS)
    around = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    corner = (task.pillar_position[:, None] + around).reshape(-1, 2)
    to_axis = jnp.sum((corner[:, None] - task.pillar_position) ** 2, axis=-1)
    is_closed = jnp.any((to_axis < reach**2) & task.pillar_active, axis=-1)
    is_closed |= jnp.sum(corner**2, axis=-1) > settings.arena_radius**2
    toll = TOLL * (is_closed | ~jnp.repeat(task.pillar_active, CORNERS))
    direct = _straight(settings, task, corner[:, None], corner[None]) + toll

    # Floyd and Warshall: after step k, the shortest paths that bend at the first k
    # corners only
    def shorten(k, length):
        return jnp.minimum(length, length[:, k, None] + length[k])

    length = direct
    if corner.shape[0]:
        length = jax.lax.fori_loop(0, corner.shape[0], shorten, direct)
    return ShortestPaths(corner, toll, length)


def path_length(
    settings: PursuitSettings, task: Task, paths: ShortestPaths, position: Team, target: Vector
) -> Each:
    """(N,) m, of the shortest path from each of (N, 3) positions to (3,) a target; its
    gradient points along the path.
    """
    # a path's first bend is one of the corners, or the target itself, from which
    # nothing is left
    from_corner = _straight(settings, task, paths.corner, target[:2])
    through_corners = jnp.min(paths.length + from_corner, axis=-1, initial=jnp.inf)
    rest = jnp.append(paths.toll + through_corners, 0.0)
    bend = jnp.concatenate([paths.corner, target[None, :2]])
    place = jax.lax.stop_gradient(position[:, None, :2])
    best = jnp.argmin(_straight(settings, task, place, bend) + rest, axis=-1)

    # which bend is best has no gradient; how far it is has one, straight towards the
    # bend
    bend, rest = jax.lax.stop_gradient((bend[best], rest[best]))
    # the small number keeps the root's gradient finite where a pursuer stands at its
    # bend
    level = jnp.sqrt(jnp.sum((position[:, :2] - bend) ** 2, axis=-1) + 1e-9) + rest
    return jnp.sqrt(level**2 + (position[:, 2] - target[2]) ** 2)


def _straight(settings, task, start, end):
    """(...,) m, from (..., 2) to (..., 2), with the toll of each pillar that is nearer
    on the path than at both its ends.
    """
    along = end - start
    square = jnp.sum(along**2, axis=-1)
    reach = _reach(settings)

    def crosses(pillar, active):
        to_axis = pillar - start
        share = jnp.sum(to_axis * along, axis=-1) / jnp.maximum(square, 1e-12)
        across = jnp.sum((to_axis - share[..., None] * along) ** 2, axis=-1)
        return active & (share > 0.0) & (share < 1.0) & (across < reach**2)

    crossings = map(crosses, task.pillar_position, task.pillar_active)
    return jnp.sqrt(square + 1e-12) + TOLL * sum(crossings, jnp.zeros(square.shape))


def _reach(settings):
    """The distance (m) that a path keeps from a pillar's axis."""
    return settings.pillar_radius + settings.pillar_clearance + ROOM
