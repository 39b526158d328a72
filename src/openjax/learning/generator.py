"""The adaptive environment generator (the paper's section IV-C, algorithm 1)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from openjax.learning.archive import TaskArchive, draw, insert
from openjax.learning.settings import GeneratorSettings
from openjax.pursuit import (
    EpisodeStatistics,
    PursuitSettings,
    Task,
    close_starts,
    empty_task,
    expand_task,
    line_up_pillars,
    shift_pillars,
    task_descriptor,
    turn_task,
    uniform_task,
)
from openjax.pursuit.shapes import Scalar


def task_like(environment: PursuitSettings) -> Task:
    """A task of zeros, of the shapes of generated ones."""
    task = empty_task(environment)
    # with one evader a task says nothing of it, and the archive has no column for it
    if len(set(environment.evaders)) > 1:
        task = task.replace(evader=jnp.zeros((), jnp.int32))
    return task


def generate_task(
    settings: GeneratorSettings,
    environment: PursuitSettings,
    archive: TaskArchive,
    key: PRNGKeyArray,
    close: Scalar | None = None,
) -> Task:
    """Draw one task: with probability p an archived one, expanded, else a uniform one.

    A share `close` of its pursuers is put close to a pillar or to another one (not in
    the paper). Where there are several evaders it has one of them, as its success rate
    is that of a task and an evader.
    """
    task = _archived_or_uniform(settings, environment, archive, key)
    if close is None:
        return task
    return close_starts(environment, jax.random.fold_in(key, 1), task, close)


def _archived_or_uniform(settings, environment, archive, key):
    uniform_key, turn_key, choice_key, draw_key, expand_key = jax.random.split(key, 5)
    uniform = uniform_task(environment, uniform_key)
    uniform = vary_pillars(settings, environment, jax.random.fold_in(uniform_key, 1), uniform)
    if len(set(environment.evaders)) > 1:
        kind = jax.random.randint(
            jax.random.fold_in(uniform_key, 2), (), 0, len(environment.evaders)
        )
        uniform = uniform.replace(evader=kind)
    # after the pillars, so that rows stand across the way of pursuers from all sides
    uniform = turn_task(turn_key, uniform)
    if not settings.enabled:
        return uniform
    # both are drawn and one is taken: mapped over worlds, a branch would work out both,
    # too
    neighbour = expand_task(
        environment, expand_key, draw(archive, draw_key), settings.wall_distance
    )
    local = (jax.random.uniform(choice_key) < settings.expansion) & (archive.size > 0)
    return jax.tree.map(lambda a, b: jnp.where(local, a, b), neighbour, uniform)


def successes(
    settings: GeneratorSettings, statistics: EpisodeStatistics, penalty_share: Scalar | float = 1.0
) -> Bool[Array, "*worlds"]:
    """True if episodes count as solved: captured, and (by setting) with few collisions.
    Any leading axes.

    `penalty_share` is the share of the penalties that counts by now (0 to 1). As it
    grows, the tolerated collision rate falls from one to the setting: before the
    penalties teach to avoid collisions, they'd keep the archive empty.
    """
    return statistics.captured & (
        statistics.collision_rate <= settings.collision_tolerance**penalty_share
    )


def select(
    settings: GeneratorSettings,
    archive: TaskArchive,
    tasks: Task,
    success: Float[Array, " tasks"],
    complete: Bool[Array, " tasks"],
) -> TaskArchive:
    """Keep the tasks that are neither solved nor hopeless.

    Args:
      settings: bounds of the success rate.
      archive: the archive so far.
      tasks: leading axis M.
      success: (M,) success rate of each.
      complete: (M,) bool, its episodes ran their full length (the first ones start
      late).
    """
    is_useful = (success >= settings.success_low) & (success <= settings.success_high)
    return insert(archive, tasks, success, is_useful & complete, task_descriptor)


def vary_pillars(settings, environment, key, task):
    """Other pillars than the paper's uniform tasks have: some of them in a row, all off
    the grid.
    """
    choice_key, row_key, shift_key = jax.random.split(key, 3)
    if settings.row_share:
        row = jax.random.uniform(choice_key) < settings.row_share
        lined_up = line_up_pillars(environment, row_key, task)
        task = jax.tree.map(lambda a, b: jnp.where(row, a, b), lined_up, task)
    return shift_pillars(environment, shift_key, task, settings.PILLAR_SHIFT)
