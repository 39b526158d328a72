"""Whole episodes of the judges' evaders, and the tasks that they learn on and are judged by."""

import jax
import jax.numpy as jnp

from openjax.evaluation.judge.learner import Evaders, decide, fly_decision
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import (
    EpisodeStatistics,
    Pursuit,
    PursuitSettings,
    Task,
    expand_task,
    turn_task,
    uniform_task,
)

JUDGE_KEY = 70_000_009
"""The tasks by which a policy is judged are drawn from this key: neither those by which runs choose
their checkpoints nor any that was trained on.
"""
MOVES = 4
"""Local expansions of a layout's starts: some .1 m along each axis."""


def draw_task(
    settings: PursuitSettings, layouts: Task, share: float, key: jax.Array
) -> Task:
    """A task to learn on: uniform and turned, or a layout (L, ...) whose starts are moved."""
    keys = jax.random.split(key, 5)
    uniform = turn_task(keys[0], uniform_task(settings, keys[1]))
    which = jax.random.randint(keys[2], (), 0, layouts.evader_position.shape[0])
    task = jax.tree.map(lambda leaf: leaf[which], layouts)

    def move(task, key):
        return expand_task(settings, key, task), None

    moved = jax.lax.scan(move, task, jax.random.split(keys[3], MOVES))[0]
    on_layout = jax.random.uniform(keys[4]) < share
    return jax.tree.map(lambda a, b: jnp.where(on_layout, a, b), moved, uniform)


def fly_learners(
    environment: Pursuit,
    policy: Policy,
    hold: int,
    parameters: PolicyParameters,
    evaders: Evaders,
    tasks: Task,
    key: jax.Array,
) -> EpisodeStatistics:
    """Statistics (L, B): an episode of each learner, without noise, on each of B tasks."""
    learners = evaders.world_axes.size
    number = tasks.evader_position.shape[0]
    reset = jax.vmap(environment.reset_to)
    world = reset(jax.random.split(key, number), tasks)

    def copies(leaf):
        return jnp.tile(leaf, (learners, *[1] * (leaf.ndim - 1)))

    world = jax.tree.map(copies, world)
    place = jnp.repeat(jnp.arange(learners), number)

    def one(world, _):
        wish = decide(environment.settings, evaders, world[1], place)
        return fly_decision(environment, policy, parameters, world, wish, hold), None

    decisions = environment.settings.episode_length // hold
    statistics = jax.lax.scan(one, world, length=decisions)[0][1].statistics
    return jax.tree.map(lambda leaf: leaf.reshape(learners, number), statistics)
