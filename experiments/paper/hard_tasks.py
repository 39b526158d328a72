"""Tasks enough to count rare failures on: pillars in a row, which hide the evader and have to be flown round, and starts close
to a pillar or another pursuer. The layouts' hundred episodes can't tell a crash in a hundred from one in a thousand.
"""

import jax

from openjax.pursuit import PursuitSettings, close_starts, line_up_pillars, turn_task, uniform_task

KEY = 77_000_001
"""From which they are drawn, the same for all policies."""


def row(settings: PursuitSettings, key: jax.Array):
    """A uniform task with its pillars in a row."""
    task_key, row_key = jax.random.split(key)
    return line_up_pillars(settings, row_key, uniform_task(settings, task_key))


def close(settings: PursuitSettings, key: jax.Array):
    """A turned uniform task in which as many pursuers as possible start close to something."""
    task_key, turn_key, close_key = jax.random.split(key, 3)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    return close_starts(settings, close_key, task, 1.0)


def drawn(settings: PursuitSettings, draw, number: int):
    """`number` tasks by `draw(settings, key)`."""
    keys = jax.random.split(jax.random.key(KEY), number)
    return jax.jit(jax.vmap(lambda key: draw(settings, key)))(keys)
