"""Tasks: where pursuers, evader and pillars start (the paper's task parameter w)."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.pursuit.collisions import breaches, drone_distance
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Flag, Quaternions, Scalar, Team
from openjax.pursuit.teams import draw_team, of_team, park

START_X = (0.1, 0.536)
"""Uniform tasks: pursuers start at x in this range, the evader at the mirrored one
(m).
"""
START_Y = 0.536
"""Uniform tasks: all start at |y| up to this (m): a corner is .76 m from the axis,
inside the arena's .9 m.
"""
START_Z = 0.1
"""Uniform tasks: |z - H/2| at the start at most (m)."""
PILLAR_GRID = 0.2
"""Pillars of uniform tasks stand on the cells of a grid of this width (m) ..."""
PILLAR_REACH = 0.8
"""... whose centre is closer to the axis than this (m): a pillar then stands inside the
arena.
"""
ROW_OFFSET = 0.2
"""Pillars in a row: its middle is up to this far from the axis along x and y (m)."""
ROW_SPACING = (0.2, 0.4)
"""Pillars in a row: distance of the axes of neighbours (m), from touching ones to a way
of 6 cm that breaches nothing.
"""
EXPANSION = 0.1
"""Local expansion moves each vehicle by up to this along each axis (m): the paper's
delta.
"""
WALL_DISTANCE = 0.1
"""Local expansion keeps starts this far from the arena's wall (m): the released
code's.
"""
CLOSE = 0.05
"""Close starts are up to this much farther from a pillar or another pursuer than the
safety distance (m).
"""
NEIGHBOURS = 0.75
"""Scattered pursuers start at most this far from their middle along x and y (m)."""
OUTSIDE = 2.0
"""Where an empty slot is taken to be when tasks are told apart (m, along each axis)."""
CANDIDATES = 8
"""Draws of a start among which the first good one is taken; more for more than three
pursuers.
"""


@struct.dataclass
class Task:
    """One task of N pursuers and P pillar slots."""

    pursuer_position: jax.Array  # (N, 3) m, world
    evader_position: jax.Array  # (3,) m, world
    pillar_position: jax.Array  # (P, 2) m, axis of each pillar
    pillar_active: jax.Array  # (P,) bool, slots in use
    evader: jax.Array | None = None
    """() int32, the place of its evader in the settings' `evaders`; None: it is drawn
    at the reset.
    """
    active: jax.Array | None = None
    """(N,) bool, the slots of pursuers in use, the first ones; None: all are."""
    evader_speed: jax.Array | None = None
    """() m/s; None: the settings' one."""
    capture_radius: jax.Array | None = None
    """() m; None: the settings' one."""
    arena_radius: jax.Array | None = None
    """() m; None: the settings' one."""

    def with_starts(self, position: Team) -> "Task":
        """The same with pursuers that start at (N, 3) m; empty slots stay where they're
        parked.
        """
        return self.replace(pursuer_position=park(position, self.active))


def evader_speed(settings: PursuitSettings, task: Task) -> float | Float[Array, "*worlds"]:
    """m/s, of the evader in a task."""
    return settings.evader_speed if task.evader_speed is None else task.evader_speed


def capture_radius(settings: PursuitSettings, task: Task) -> float | Float[Array, "*worlds"]:
    """m, in a task."""
    return settings.capture_radius if task.capture_radius is None else task.capture_radius


def arena_of(settings: PursuitSettings, task: Task) -> PursuitSettings:
    """The game in a task's own arena, whose radius is traced then: such settings are
    for the functions of one world, and can't be checked, compared or hashed.
    """
    if task.arena_radius is None:
        return settings
    of_task = copy.copy(settings)
    object.__setattr__(of_task, "arena_radius", task.arena_radius)
    return of_task


def empty_task(settings: PursuitSettings) -> Task:
    """A task of zeros, of the game's shapes."""
    return Task(
        pursuer_position=jnp.zeros((settings.num_pursuers, 3), jnp.float32),
        evader_position=jnp.zeros(3, jnp.float32),
        pillar_position=jnp.zeros((settings.max_pillars, 2), jnp.float32),
        pillar_active=jnp.zeros(settings.max_pillars, bool),
        active=jnp.zeros(settings.num_pursuers, bool) if settings.team_sizes else None,
        evader_speed=jnp.zeros((), jnp.float32) if settings.evader_speeds else None,
        capture_radius=jnp.zeros((), jnp.float32) if settings.capture_radii else None,
        arena_radius=jnp.zeros((), jnp.float32) if settings.arena_radii else None,
    )


def task_descriptor(tasks: Task) -> Float[Array, "tasks features"]:
    """(M, D) what tells M tasks apart: all start positions and the pillars in use (m),
    and the numbers of its own that a task has.
    """
    # two tasks that differ in slots that aren't used are the same
    pillars = jnp.where(tasks.pillar_active[..., None], tasks.pillar_position, 0.0)
    m = pillars.shape[0]
    pursuers = tasks.pursuer_position
    if tasks.active is not None:
        pursuers = jnp.where(tasks.active[..., None], pursuers, OUTSIDE)
    parts = [pursuers.reshape(m, -1), tasks.evader_position.reshape(m, -1), pillars.reshape(m, -1)]
    numbers = (tasks.evader_speed, tasks.capture_radius, tasks.arena_radius)
    parts += [number[:, None] for number in numbers if number is not None]
    return jnp.concatenate(parts, axis=-1)


def starts_clear(settings: PursuitSettings, task: Task) -> Flag:
    """True if no pursuer starts in a breach and the evader starts outside all pillars. () bool."""
    breach = breaches(
        arena_of(settings, task), task.pursuer_position, task.pillar_position, task.pillar_active
    )
    clear_of_evader = _clear_of(settings, task.pillar_position, task.evader_position[None, :2])
    is_breach = jnp.any(of_team(task.active, breach.total) > 0)
    is_over_evader = jnp.any(task.pillar_active & ~clear_of_evader)
    return ~(is_breach | is_over_evader)


def pillar_cells() -> Float[np.ndarray, "cells 2"]:
    """(cells, 2) centres of the grid cells on which a uniform task may put a pillar
    (m).
    """
    steps = np.arange(-4, 5) * PILLAR_GRID
    x, y = np.meshgrid(steps, steps, indexing="ij")
    cells = np.stack([x.ravel(), y.ravel()], axis=-1)
    # less a rounding error: cells exactly that far out don't count
    return cells[np.linalg.norm(cells, axis=-1) < PILLAR_REACH - 1e-6]


def uniform_task(settings: PursuitSettings, key: PRNGKeyArray) -> Task:
    """Draw a task uniformly: the paper's global exploration.

    Pursuers on one side, the evader on the other, pillars on distinct free cells of a
    grid. Among a few draws of the pursuers' starts the first without a breach is taken;
    cells too close to a start stay free.
    """
    n = settings.num_pursuers
    position_key, evader_key, number_key, cell_key = jax.random.split(key, 4)
    task = empty_task(settings).replace(
        active=draw_team(settings, key),
        evader_speed=_between(settings.evader_speeds, key, 5),
        capture_radius=_between(settings.capture_radii, key, 6),
        arena_radius=_between(settings.arena_radii, key, 7),
    )
    scale = _arena_scale(settings, task)
    wide = jnp.stack([scale, scale, 1.0]).astype(jnp.float32)
    middle = settings.arena_height / 2
    low = wide * jnp.array([START_X[0], -START_Y, middle - START_Z], jnp.float32)
    high = wide * jnp.array([START_X[1], START_Y, middle + START_Z], jnp.float32)
    # each further pursuer about halves the chance that all are apart
    draws = CANDIDATES * 2 ** max(0, n - 3)
    # all candidates at once and the first good one: a loop that draws until one is good
    # would have no fixed length
    candidates = jax.random.uniform(position_key, (draws, n, 3), jnp.float32, low, high)
    is_apart = jax.vmap(
        lambda p: jnp.all(drone_distance(park(p, task.active)) >= settings.drone_clearance)
    )(candidates)
    # where none is good, `argmax` gives the first: such a task starts in a breach
    task = task.with_starts(candidates[jnp.argmax(is_apart)])
    mirror = jnp.array([-1.0, 1.0, 1.0], jnp.float32)
    evader = jax.random.uniform(evader_key, (3,), jnp.float32, low, high) * mirror
    task = task.replace(evader_position=evader)
    return _with_pillars(settings, task, number_key, cell_key)


def _with_pillars(settings, task, number_key, cell_key):
    """The task with pillars on cells of the grid, as much wider as the arena, that are
    free of vehicles.
    """
    starts = jnp.concatenate([task.pursuer_position, task.evader_position[None]])
    vehicles = starts[:, :2]
    scale = _arena_scale(settings, task)
    cells = scale * jnp.asarray(pillar_cells(), jnp.float32)
    holds_vehicle = jnp.all(
        jnp.abs(cells[:, None] - vehicles[None]) <= scale * PILLAR_GRID / 2, axis=-1
    )
    free = _clear_of(settings, cells, vehicles) & ~jnp.any(holds_vehicle, axis=-1)
    # the first ones of a random order are a draw without replacement; cells that aren't
    # free come last
    rank = jnp.where(free, jax.random.uniform(cell_key, (cells.shape[0],)), -1.0)
    slots = jax.lax.top_k(rank, settings.max_pillars)[1]
    number = jax.random.randint(number_key, (), settings.min_pillars, settings.max_pillars + 1)
    # fewer than drawn where not enough cells are free
    in_use = (jnp.arange(settings.max_pillars) < number) & free[slots]
    pillars = jnp.where(in_use[:, None], cells[slots], 0.0)
    return task.replace(pillar_position=pillars, pillar_active=in_use)


def _between(ends, key, number):
    """() drawn between two ends, by the `number`-th key folded from a task's; None
    without ends.
    """
    if not ends:
        return None
    return jax.random.uniform(jax.random.fold_in(key, number), (), jnp.float32, *ends)


def expand_task(
    settings: PursuitSettings, key: PRNGKeyArray, task: Task, wall_distance: float = WALL_DISTANCE
) -> Task:
    """Move every vehicle of a task a little and keep its pillars: the paper's local
    expansion.

    Starts stay `wall_distance` (m) from the arena's wall and within 0.1 m of half its
    height. Among a few draws the first that starts clear is taken, else the task
    itself.
    """
    radius_of_arena = arena_of(settings, task).arena_radius

    def draw(key):
        pursuer_key, evader_key = jax.random.split(key)

        def move(key, position):
            candidate = position + jax.random.uniform(
                key, position.shape, jnp.float32, -EXPANSION, EXPANSION
            )
            # who would come too near the wall is drawn back along the radius
            radius = jnp.linalg.norm(candidate[..., :2], axis=-1, keepdims=True)
            reach = radius_of_arena - wall_distance
            xy = candidate[..., :2] * jnp.minimum(1.0, reach / jnp.maximum(radius, 1e-6))
            return jnp.concatenate([xy, _start_height(settings, candidate[..., 2:])], axis=-1)

        candidate = task.replace(evader_position=move(evader_key, task.evader_position))
        return candidate.with_starts(move(pursuer_key, task.pursuer_position))

    return _first_clear(settings, draw, key, task)


def close_starts(
    settings: PursuitSettings, key: PRNGKeyArray, task: Task, share: float | Scalar
) -> Task:
    """Put a `share` (0 to 1) of the pursuers next to a pillar or another pursuer:
    starts that leave the least room.

    They stand 0 to 0.05 m outside its safety distance, in any direction, within 0.1 m
    of half the arena's height. One is placed after the other: beside a pillar, or
    beside a pursuer whose start is settled, with equal odds where there are both. Among
    a few draws the first that starts clear is taken, else the task itself.
    """
    start = task.pursuer_position
    n = task.pursuer_position.shape[0]
    no_pillar = ~jnp.any(task.pillar_active)

    def place(position, i, key):
        """All positions (N, 3) after pursuer i was put beside a pillar or one of those
        before it.
        """
        kind_key, which_key, direction_key, gap_key = jax.random.split(key, 4)
        pillar = jax.random.categorical(which_key, jnp.where(task.pillar_active, 0.0, -jnp.inf))
        beside = jnp.append(task.pillar_position[pillar], position[i, 2])
        by_pursuer = (jax.random.bernoulli(kind_key) | no_pillar) & (i > 0)
        # the pillar's key once more: of the two draws only one is used
        partner = jax.random.randint(which_key, (), 0, max(i, 1))
        anchor = jnp.where(by_pursuer, position[partner], beside)
        clearance = jnp.where(
            by_pursuer, settings.drone_clearance, settings.pillar_radius + settings.pillar_clearance
        )
        # normal numbers point in all directions alike
        away = jax.random.normal(direction_key, (3,))
        away = away.at[2].multiply(by_pursuer)  # a pillar is as high as the arena
        gap = jax.random.uniform(gap_key, (), jnp.float32, 0.0, CLOSE)
        close = anchor + (clearance + gap) * away / jnp.linalg.norm(away)
        close = close.at[2].set(_start_height(settings, close[2]))
        return jnp.where(no_pillar & ~by_pursuer, position, position.at[i].set(close))

    def draw(key):
        choice_key, place_key = jax.random.split(key)
        is_moved = jax.random.uniform(choice_key, (n,)) < share
        position = start
        # one after the other, so that nobody is put beside a start that moves away
        # again
        for i, key in enumerate(jax.random.split(place_key, n)):
            position = jnp.where(is_moved[i], place(position, i, key), position)
        return task.with_starts(position)

    return _first_clear(settings, draw, key, task)


def scatter_starts(settings: PursuitSettings, key: PRNGKeyArray, task: Task) -> Task:
    """Start evader and pursuers anywhere up to `WALL_DISTANCE` from the arena's wall,
    the pursuers more or less together.

    Uniform tasks keep both within 0.76 m of the axis and 1.1 m of each other along x.
    Among a few draws the first that starts clear is taken, else the task itself.
    """
    reach = arena_of(settings, task).arena_radius - WALL_DISTANCE
    n = task.pursuer_position.shape[0]

    def draw(key):
        middle_key, apart_key, offset_key, height_key = jax.random.split(key, 4)
        # columns are places: the pursuers' middle, the evader; the root, so that equal
        # shares are equal areas
        share, turn = jax.random.uniform(middle_key, (2, 2))
        angle = 2.0 * np.pi * turn
        xy = reach * jnp.sqrt(share) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        offset = jax.random.uniform(offset_key, (n, 2), minval=-NEIGHBOURS, maxval=NEIGHBOURS)
        # one factor for all: in some tasks they start together, in others all over the
        # arena
        pursuers = xy[:, 0] + offset * jax.random.uniform(apart_key)
        from_axis = jnp.linalg.norm(pursuers, axis=-1, keepdims=True)
        pursuers = pursuers * jnp.minimum(1.0, reach / jnp.maximum(from_axis, 1e-6))
        middle = settings.arena_height / 2
        z = jax.random.uniform(
            height_key, (n + 1, 1), minval=middle - START_Z, maxval=middle + START_Z
        )
        scatter = task.replace(evader_position=jnp.append(xy[:, 1], z[0]))
        return scatter.with_starts(jnp.concatenate([pursuers, z[1:]], axis=-1))

    return _first_clear(settings, draw, key, task)


def _start_height(settings, z):
    """Heights z (m), cut to those at which a vehicle may start."""
    middle = settings.arena_height / 2
    return jnp.clip(z, middle - START_Z, middle + START_Z)


def _first_clear(settings, draw, key, task):
    """The first of a few tasks drawn by `draw(key)` that starts clear, else `task`."""
    # all at once, as in a uniform task: a loop until one is clear has no fixed length
    candidates = jax.vmap(draw)(jax.random.split(key, CANDIDATES))
    clear = jax.vmap(lambda candidate: starts_clear(settings, candidate))(candidates)
    first = jnp.argmax(clear)
    return jax.tree.map(
        lambda tasks, seed: jnp.where(jnp.any(clear), tasks[first], seed), candidates, task
    )


def shift_pillars(settings: PursuitSettings, key: PRNGKeyArray, task: Task, reach: float) -> Task:
    """Move each pillar by up to `reach` (m) along x and y; those that would come too
    close to a start stay.
    """
    offset = jax.random.uniform(key, task.pillar_position.shape, jnp.float32, -reach, reach)
    return _move_pillars(settings, task, task.pillar_position + offset)


def line_up_pillars(settings: PursuitSettings, key: PRNGKeyArray, task: Task) -> Task:
    """Put the pillars of a uniform task in a row across the arena, between the
    pursuers' side and the evader's.

    The row's middle lies within 0.2 m of the axis along x and y, it is turned by up to
    45 degrees, and its pillars stand 0.2 m (touching) to 0.4 m apart. Those that would
    come too close to a start or to the wall stay. In a wider arena all but the touching
    ones are farther apart, so that rows close it as often.
    """
    scale = _arena_scale(settings, task)
    middle_key, angle_key, spacing_key = jax.random.split(key, 3)
    middle = scale * jax.random.uniform(middle_key, (2,), jnp.float32, -ROW_OFFSET, ROW_OFFSET)
    angle = jax.random.uniform(angle_key, (), jnp.float32, -np.pi / 4, np.pi / 4)
    spacing = scale * jax.random.uniform(spacing_key, (), jnp.float32, *ROW_SPACING)
    spacing = jnp.maximum(spacing, ROW_SPACING[0])
    # symmetric about the row's middle, whatever the number of pillars
    number = jnp.sum(task.pillar_active)
    along = (jnp.arange(task.pillar_active.shape[0]) - (number - 1) / 2) * spacing
    direction = jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
    return _move_pillars(settings, task, middle + along[:, None] * direction)


def _arena_scale(settings, task):
    """The radius of a task's arena as a multiple of the paper's."""
    return arena_of(settings, task).arena_radius / PursuitSettings.arena_radius


def _move_pillars(settings, task, position):
    """The task with those pillars moved that stay within reach of the axis and clear of
    all starts.
    """
    vehicles = jnp.concatenate([task.pursuer_position, task.evader_position[None]])[:, :2]
    reach = PILLAR_REACH * _arena_scale(settings, task)
    inside = jnp.linalg.norm(position, axis=-1) < reach
    # each pillar by itself: a row may have gaps
    moves = (_clear_of(settings, position, vehicles) & inside & task.pillar_active)[:, None]
    return task.replace(pillar_position=jnp.where(moves, position, task.pillar_position))


def _clear_of(settings, pillars, vehicles):
    """(P,) whether pillars at (P, 2) keep their distance from all vehicles at (K,
    2).
    """
    distance = jnp.linalg.norm(pillars[:, None] - vehicles[None], axis=-1)
    return jnp.all(distance >= settings.pillar_radius + settings.pillar_clearance, axis=-1)


def turn_task(key: PRNGKeyArray, task: Task) -> Task:
    """Turn a whole task about the arena's axis by a random angle: the game looks the
    same from every side.
    """
    angle = jax.random.uniform(key, (), jnp.float32, -np.pi, np.pi)
    cosine = jnp.cos(angle)
    sine = jnp.sin(angle)

    def turn(position):
        x = position[..., 0]
        y = position[..., 1]
        xy = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        return jnp.concatenate([xy, position[..., 2:]], axis=-1)

    turned_task = task.replace(
        evader_position=turn(task.evader_position), pillar_position=turn(task.pillar_position)
    )
    return turned_task.with_starts(turn(task.pursuer_position))


def start_attitude(settings: PursuitSettings, key: PRNGKeyArray) -> Quaternions:
    """(N, 4) start quaternions wxyz: roll and pitch within 36 degrees, yaw in 0 to 36
    degrees; or all level.
    """
    n = settings.num_pursuers
    if settings.start_attitude == "level":
        return jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0], jnp.float32), (n, 4))
    limit = 0.2 * np.pi
    low = jnp.array([-limit, -limit, 0.0], jnp.float32)
    half = 0.5 * jax.random.uniform(key, (n, 3), jnp.float32, low, jnp.float32(limit))
    # yaw after pitch after roll, by their half angles
    cr, cp, cy = jnp.cos(half).T
    sr, sp, sy = jnp.sin(half).T
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )
