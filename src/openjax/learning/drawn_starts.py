"""Starts to learn from by the gradient through the simulation: those that leave the least room."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from openjax.pursuit import PursuitSettings, Task, close_starts, turn_task, uniform_task
from openjax.pursuit.collisions import drone_distance
from openjax.pursuit.teams import parked

CLOSE = 0.45
SIDE_BY_SIDE = 0.35
"""Shares of the starts close to something (70 % of the pursuers), and of those in which all stand
side by side.
"""
APART = 0.1
"""Farthest gap beyond the safety distance of pursuers side by side (m)."""


def side_by_side(settings: PursuitSettings, key: PRNGKeyArray, task: Task) -> Task:
    """A task whose pursuers all start beside one before them; as it was where that would breach
    something.
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
        position = parked(position, task.active)
    clear_of_pillars = ~jnp.any(task.pillar_active & (to_axis < room))
    # less a rounding error: two that stand exactly as close as they may are apart
    apart = jnp.all(drone_distance(position) >= settings.drone_clearance - 1e-4)
    clear = clear_of_pillars & apart
    return task.with_starts(jnp.where(clear, position, task.pursuer_position))


def draw_start(settings: PursuitSettings, key: PRNGKeyArray) -> Task:
    """A task to learn from: close to something, side by side, or any."""
    task_key, turn_key, start_key, choice_key = jax.random.split(key, 4)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    # with a share of the pursuers left where they are, so that not all starts are tight
    near = close_starts(settings, start_key, task, 0.7)
    beside = side_by_side(settings, start_key, task) if settings.num_pursuers > 1 else near
    kind = jax.random.uniform(choice_key)
    return jax.tree.map(
        lambda a, b, c: jnp.where(kind < CLOSE, a, jnp.where(kind < CLOSE + SIDE_BY_SIDE, b, c)),
        near,
        beside,
        task,
    )
