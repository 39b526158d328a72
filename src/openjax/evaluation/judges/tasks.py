"""The tasks that a judge's evaders learn on, and those by which a policy is judged."""

import dataclasses

import jax
import jax.numpy as jnp

from openjax.evaluation.judges.settings import BestResponseSettings
from openjax.evaluation.validation import uniform_tasks
from openjax.pursuit import PursuitSettings, Task, expand_task, turn_task, uniform_task

JUDGE_KEY = 70_000_009
"""The tasks by which a policy is judged are drawn from this key: neither those by which
runs choose their checkpoints nor any that was trained on.
"""
OWN = 0.75
"""Share of a specialist's episodes that begin in its layout."""
MOVES = 4
"""Local expansions of a layout's starts: some .1 m along each axis."""


def draw_task(
    settings: PursuitSettings, layouts: Task | None, share: float, key: jax.Array
) -> Task:
    """A task to learn on: uniform and turned, or, with these odds, a layout (L, ...)
    whose starts are moved. None: the game's number of pursuers has no layouts.
    """
    keys = jax.random.split(key, 5)
    uniform = turn_task(keys[0], uniform_task(settings, keys[1]))
    if layouts is None:
        return uniform
    which = jax.random.randint(keys[2], (), 0, layouts.evader_position.shape[0])
    task = jax.tree.map(lambda leaf: leaf[which], layouts)

    def move(task, key):
        return expand_task(settings, key, task), None

    nearby = jax.lax.scan(move, task, jax.random.split(keys[3], MOVES))[0]
    on_layout = jax.random.uniform(keys[4]) < share
    return jax.tree.map(lambda a, b: jnp.where(on_layout, a, b), nearby, uniform)


def draw_own_task(
    settings: PursuitSettings,
    layouts: Task,
    learning: BestResponseSettings,
    key: jax.Array,
    learner: jax.Array,
) -> Task:
    """A task for one of the learners, () int: of the last ones, specialists, mostly a
    layout of its own out of `layouts` (L, ...).
    """
    number = layouts.evader_position.shape[0]
    place = learner - (learning.learners - learning.specialists)
    one = jax.tree.map(lambda leaf: leaf[place % number][None], layouts)
    any_key, own_key = jax.random.split(key)
    of_any = draw_task(settings, layouts, learning.layouts, any_key)
    of_layout = draw_task(settings, one, OWN, own_key)
    return jax.tree.map(lambda a, b: jnp.where(place >= 0, a, b), of_layout, of_any)


def judging_tasks(settings: PursuitSettings, number: int) -> Task:
    """(number, ...) uniform tasks of the paper's four or five pillars, in the game's
    slots.
    """
    paper = PursuitSettings()
    game = dataclasses.replace(
        settings, min_pillars=paper.min_pillars, max_pillars=paper.max_pillars
    )
    return uniform_tasks(game, number, settings.max_pillars, JUDGE_KEY)
