"""The evaders' behaviours: pure functions of what an evader knows and of its memory, of static
shapes.

    behaviour(scene, memory) -> wish (3,), memory (MEMORY,)

A wish is a velocity as a share of the evader's speed, of at most length one.
`openjax.pursuit.evaders.evader` sees to the speed, the acceleration and what is solid.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.evaders.kinds import MEMORY as MEMORY
from openjax.pursuit.sensing import line_of_sight
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Active, Memory, Pillars, Team, Vector
from openjax.vehicle import DroneState
from openjax.vehicle.vectors import length, unit

DIRECTIONS = 64
"""That a greedy evader tries; one that looks two steps ahead tries half as many at
each.
"""
MARGIN = 0.02
"""Distance (m) at which an evader keeps off pillars and the arena's bounds."""
AROUND = 0.1
"""A pillar's hugger stays this far from its surface, and way-points are left when
nearer than this (m).
"""
PLACES = 128
"""In the arena, among which one looks for the safest."""
R_SEQUENCE = 1.2207440846057596 ** -np.arange(1.0, 4.0)
"""Steps from point to point of a sequence of low discrepancy: by the root of x^4 = x +
1 (Roberts 2018, The unreasonable effectiveness of quasirandom sequences).
"""
FAR_AWAY = 100.0
"""Distance (m) at which pursuers are put that an evader doesn't know of."""


@struct.dataclass
class Scene:
    """An evader's knowledge of its world."""

    settings: PursuitSettings = struct.field(pytree_node=False)
    position: jax.Array  # (3,) m, its own
    velocity: jax.Array  # (3,) m/s, its own in the last step
    pursuers: jax.Array  # (N, 3) m
    known: jax.Array  # (N,) bool, the pursuers that it knows of; none of an empty slot
    pillar_position: jax.Array  # (P, 2) m
    pillar_active: jax.Array  # (P,) bool
    look_ahead: jax.Array  # () s
    hiding: jax.Array  # () m
    reach: jax.Array  # () m/s, its speed
    drones: DroneState | None = None
    """the pursuers' whole state, leading axis N, whether it knows of them or not"""
    world: Any = None
    """the whole state of the world, `openjax.pursuit.PursuitState`"""
    key: jax.Array | None = None
    """() another one in each step; None where no evader of the game is one's own"""
    active: jax.Array | None = None
    """(N,) bool, the slots of pursuers in use; None: all are"""

    @property
    def pursuer_velocity(self) -> Team:
        """(N, 3) m/s, world."""
        return self.drones.velocity

    @property
    def thrust_direction(self) -> Team:
        """(N, 3) unit vectors, world: where each pursuer's rotors pull, and so what it
        is about to do.
        """
        return rotation_axes(self.drones.quaternion)[1]

    @property
    def nearest(self) -> Vector:
        """(3,) m, the nearest pursuer that it knows of."""
        squares = jnp.sum((self.pursuers - self.position) ** 2, axis=-1)
        squares = jnp.where(self.known, squares, jnp.inf)
        # a sum over all but one, cheaper on an accelerator than an index
        is_nearest = jnp.arange(squares.shape[0])[:, None] == jnp.argmin(squares)
        return jnp.sum(jnp.where(is_nearest, self.pursuers, 0.0), axis=0)


def directions(number: int) -> Float[np.ndarray, "{number} 3"]:
    """(number, 3) unit vectors spread evenly over the sphere: a Fibonacci lattice."""
    i = np.arange(number) + 0.5
    z = 1.0 - 2.0 * i / number
    angle = np.pi * (1.0 + 5.0**0.5) * i
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).astype(np.float32)


def into_free_space(
    settings: PursuitSettings,
    place: Float[Array, "*places 3"],
    pillar_position: Pillars,
    pillar_active: Active,
) -> Float[Array, "*places 3"]:
    """(..., 3) the points nearest to `place` (..., 3) that keep their distance from
    bounds and one pillar.
    """
    xy = place[..., :2]
    z = place[..., 2:]
    offset = xy[..., None, :] - pillar_position
    distance = _length(offset)
    depth = jnp.maximum(settings.pillar_radius + MARGIN - distance, 0.0)
    xy = xy + jnp.sum(jnp.where(pillar_active[:, None], offset / distance * depth, 0.0), axis=-2)
    xy = xy * jnp.minimum(1.0, (settings.arena_radius - MARGIN) / _length(xy))
    return jnp.concatenate([xy, jnp.clip(z, MARGIN, settings.arena_height - MARGIN)], axis=-1)


def greedy(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Fly to where, after the look-ahead, the nearest pursuer is farthest away."""
    candidates = directions(DIRECTIONS)
    ends, open_way = _ends(scene, scene.position, candidates)
    score = jnp.where(open_way, _nearness(scene, ends, scene.pursuers), -jnp.inf)
    # who knows of nobody stays where it is
    return _choose(candidates, score) * jnp.any(scene.known), memory


def two_step(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """The same over two steps; after the first the pursuers have come closer, each
    straight to where it went.
    """
    candidates = directions(DIRECTIONS // 2)
    first, open_way = _ends(scene, scene.position, candidates)

    def best_after(end):
        # as if they knew where it goes, at full speed: nothing is worse for it
        to_end = end - scene.pursuers
        step = jnp.minimum(scene.settings.max_speed * scene.look_ahead / _length(to_end), 1.0)
        answer = scene.pursuers + step * to_end
        second, open_then = _ends(scene, end, candidates)
        nearness = jnp.where(open_then, _nearness(scene, second, answer), -jnp.inf)
        return jnp.minimum(_nearness(scene, end[None], answer)[0], jnp.max(nearness))

    score = jnp.where(open_way, jax.vmap(best_after)(first), -jnp.inf)
    return _choose(candidates, score) * jnp.any(scene.known), memory


def wall_runner(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Run along the wall, round the arena and up or down, away from the nearest
    pursuer.
    """
    settings = scene.settings
    threat = scene.nearest
    radius = _length(scene.position[:2])
    out = scene.position[:2] / radius
    tangent = jnp.stack([-out[1], out[0]])
    # the sign of the cross product says on which side of it the pursuer is; it runs to
    # the other
    side = jnp.where(threat[0] * out[1] - threat[1] * out[0] >= 0.0, 1.0, -1.0)
    # towards its distance from the wall, from either side
    outward = jnp.clip((settings.arena_radius - AROUND - radius) / AROUND, -1.0, 1.0)
    goal = jnp.where(threat[2] > settings.arena_height / 2, AROUND, settings.arena_height - AROUND)
    climb = 0.5 * jnp.clip((goal - scene.position[2:]) / AROUND, -1.0, 1.0)
    return unit(jnp.concatenate([side * tangent + outward * out, climb])), memory


def pillar_hugger(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Stay behind a pillar, as seen by the nearest pursuer; where there is none, fly
    straight away from it.
    """
    threat = scene.nearest
    pillars = scene.pillar_position
    behind = pillars - threat[:2]
    behind = pillars + behind / _length(behind) * (scene.settings.pillar_radius + AROUND)
    distance = jnp.where(scene.pillar_active, _length(behind - scene.position[:2])[:, 0], jnp.inf)
    is_chosen = jnp.arange(distance.shape[0])[:, None] == jnp.argmin(distance)
    goal = jnp.concatenate([jnp.sum(jnp.where(is_chosen, behind, 0.0), axis=0), scene.position[2:]])
    to_goal = goal - scene.position
    away = unit(scene.position - threat)
    to_cover = to_goal / jnp.maximum(_length(to_goal), AROUND)
    return jnp.where(jnp.any(scene.pillar_active), to_cover, away), memory


def safe_place(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Fly to the place, of many all over the arena, that it would reach the longest
    before any pursuer; none behind a pillar.
    """
    settings = scene.settings
    # the same places in every step, which fill the arena evenly
    share = np.mod(0.5 + np.arange(PLACES)[:, None] * R_SEQUENCE[[1, 0, 2]], 1.0)
    places = _free_place(scene, jnp.asarray(share, jnp.float32))
    to_place = places - scene.position
    own_time = _length(to_place)[:, 0] / scene.reach
    # as if they flew straight, pillars or not
    their_time = _length(places[:, None] - scene.pursuers)[..., 0] / settings.max_speed
    lead = jnp.min(jnp.where(scene.known, their_time, FAR_AWAY), axis=-1) - own_time
    in_the_open = line_of_sight(
        settings, places, scene.position, scene.pillar_position, scene.pillar_active
    )
    lead = jnp.where(in_the_open, lead, -jnp.inf)
    direction = _choose(to_place, lead)
    return direction / jnp.maximum(_length(direction), MARGIN), memory


def way_points(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Fly from point to point, whatever the pursuers do. The points are a sequence of
    low discrepancy from a drawn one on.
    """
    # three shares say where the present point lies, the fourth number how long (s) it
    # is flown to; more follows where another evader of the game remembers more
    share = memory[:3]
    rest = memory[4:]
    to_goal = _free_place(scene, share) - scene.position
    # after a second it gives up a point that it doesn't reach
    seconds_left = memory[3] - scene.settings.time_step
    is_done = (_length(to_goal)[0] < AROUND) | (seconds_left < 0.0)
    next_point = jnp.append(jnp.mod(share + R_SEQUENCE, 1.0), 1.0)
    point = jnp.where(is_done, next_point, jnp.append(share, seconds_left))
    return unit(to_goal), jnp.concatenate([point, rest])


def frozen(scene: Scene, memory: Memory) -> tuple[Vector, Memory]:
    """Stay where it is."""
    return jnp.zeros_like(scene.position), memory


BEHAVIOURS: dict[str, Callable[[Scene, Any], tuple[jax.Array, Any]]] = {
    "greedy": greedy,
    "two_step": two_step,
    "wall_runner": wall_runner,
    "pillar_hugger": pillar_hugger,
    "safe_place": safe_place,
    "way_points": way_points,
    "frozen": frozen,
}


def _free_place(scene, share):
    """(..., 3) m, a place outside pillars at shares (..., 3) from 0 to 1 of a turn, of
    the arena's area and of its height.
    """
    settings = scene.settings
    angle = 2.0 * jnp.pi * share[..., 0]
    # the root, so that equal shares are equal areas
    radius = settings.arena_radius * jnp.sqrt(share[..., 1])
    place = [
        radius * jnp.cos(angle),
        radius * jnp.sin(angle),
        settings.arena_height * share[..., 2],
    ]
    return into_free_space(
        settings, jnp.stack(place, axis=-1), scene.pillar_position, scene.pillar_active
    )


def _ends(scene, start, candidates):
    """(K, 3) where K directions lead within the look-ahead, and (K,) whether no pillar
    is in the way.
    """
    pillars = scene.pillar_position
    active = scene.pillar_active
    ends = start + scene.reach * scene.look_ahead * candidates
    ends = into_free_space(scene.settings, ends, pillars, active)
    return ends, line_of_sight(scene.settings, ends, start, pillars, active)


def _nearness(scene, ends, pursuers):
    """(K,) m, from (K, 3) places to the nearest of (N, 3) pursuers; those without a
    line of sight count farther.
    """
    distance = _length(ends[:, None] - pursuers)[..., 0]
    sees = jax.vmap(
        lambda end: line_of_sight(
            scene.settings, pursuers, end, scene.pillar_position, scene.pillar_active
        )
    )(ends)
    # hiding pays as if the pursuer were that much farther
    distance = distance + jnp.where(sees, 0.0, scene.hiding)
    return jnp.min(jnp.where(scene.known, distance, FAR_AWAY), axis=-1)


def _choose(candidates, score):
    """The direction of the highest score, by a sum: cheaper on an accelerator than a
    gather.
    """
    is_best = jnp.arange(candidates.shape[0])[:, None] == jnp.argmax(score)
    return jnp.sum(jnp.where(is_best, candidates, 0.0), axis=0)


def _length(vector):
    return length(vector, keepdims=True)
