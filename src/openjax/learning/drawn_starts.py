"""Starts to learn from by the gradient through the simulation, and which worlds need a
new one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from openjax.learning.generator import vary_pillars
from openjax.learning.gradient.measures import nearest_gap
from openjax.learning.settings import GeneratorSettings
from openjax.pursuit import (
    PursuitSettings,
    PursuitState,
    Task,
    close_starts,
    scatter_starts,
    turn_task,
    uniform_task,
)
from openjax.pursuit.collisions import drone_distance
from openjax.pursuit.task import arena_of
from openjax.pursuit.teams import park

CLOSE = 0.45
"""Share of the starts in which most pursuers stand close to something."""
MOST = 0.7
"""Share of the pursuers that do: with some left where they are, not all starts are
tight.
"""
SIDE_BY_SIDE = 0.35
"""Share of the starts in which all stand side by side; what is left of both are uniform
ones.
"""
APART = 0.1
"""Farthest gap beyond the safety distance of pursuers side by side (m)."""
SCATTERED = 0.5
"""Share of the tasks that start anywhere: who knows the uniform ones alone dives where
the evader is far, into the floor.
"""
OUTSIDE = 1.2
"""A pursuer is lost where it is farther out than this share of the arena's radius or
height.
"""


def side_by_side(settings: PursuitSettings, key: PRNGKeyArray, task: Task) -> Task:
    """A task whose pursuers all start beside one before them; as it was where that
    would breach something.
    """
    position = task.pursuer_position
    for i, pursuer_key in enumerate(jax.random.split(key, position.shape[0] - 1), start=1):
        which_key, direction_key, gap_key = jax.random.split(pursuer_key, 3)
        # rather beside than above one another
        away = jax.random.normal(direction_key, (3,)) * jnp.array([1.0, 1.0, 0.3])
        gap = settings.drone_clearance + jax.random.uniform(gap_key, (), maxval=APART)
        neighbour = position[jax.random.randint(which_key, (), 0, i)]
        position = position.at[i].set(neighbour + gap * away / jnp.linalg.norm(away))
    to_axis = jnp.linalg.norm(position[:, None, :2] - task.pillar_position[None], axis=-1)
    room = settings.pillar_radius + settings.pillar_clearance
    if task.active is not None:
        to_axis = jnp.where(task.active[:, None], to_axis, jnp.inf)
        position = park(position, task.active)
    clear_of_pillars = ~jnp.any(task.pillar_active & (to_axis < room))
    # less a rounding error: two that stand exactly as close as they may are apart
    are_clear = jnp.all(drone_distance(position) >= settings.drone_clearance - 1e-4)
    clear = clear_of_pillars & are_clear
    return task.with_starts(jnp.where(clear, position, task.pursuer_position))


def draw_start(settings: PursuitSettings, key: PRNGKeyArray) -> Task:
    """A task to learn from: close to something, side by side, or any."""
    task_key, turn_key, start_key, choice_key = jax.random.split(key, 4)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    close_task = close_starts(settings, start_key, task, MOST)
    beside = side_by_side(settings, start_key, task) if settings.num_pursuers > 1 else close_task
    kind = jax.random.uniform(choice_key)
    return jax.tree.map(
        lambda a, b, c: jnp.where(kind < CLOSE, a, jnp.where(kind < CLOSE + SIDE_BY_SIDE, b, c)),
        close_task,
        beside,
        task,
    )


def draw_anywhere(settings: PursuitSettings, tasks: GeneratorSettings, key: PRNGKeyArray) -> Task:
    """A task like the uniform ones that a generator with settings `tasks` draws,
    turned; with its starts, or with any others.
    """
    task_key, pillar_key, turn_key, start_key, choice_key = jax.random.split(key, 5)
    task = vary_pillars(tasks, settings, pillar_key, uniform_task(settings, task_key))
    task = turn_task(turn_key, task)
    is_scattered = jax.random.bernoulli(choice_key, SCATTERED)
    anywhere = scatter_starts(settings, start_key, task)
    return jax.tree.map(lambda a, b: jnp.where(is_scattered, a, b), anywhere, task)


def is_lost(settings: PursuitSettings, state: PursuitState) -> Bool[Array, " worlds"]:
    """(W,) whether a pursuer of worlds (W, ...) has crashed or is far outside."""
    position = state.drones.position
    # of all worlds, or of each
    radius = jnp.expand_dims(arena_of(settings, state.task).arena_radius, -1)
    outside = jnp.sum(position[..., :2] ** 2, axis=-1) > (OUTSIDE * radius) ** 2
    outside |= position[..., 2] > OUTSIDE * settings.arena_height
    outside |= nearest_gap(settings, state) < 0.0
    if state.active is not None:
        outside &= state.active
    return jnp.any(outside, axis=-1)
