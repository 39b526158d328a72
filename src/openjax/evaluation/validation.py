"""Validation tasks, never trained on: the same in every run, to watch it and to choose
its best checkpoint. Never the layouts.
"""

import dataclasses

import jax
import jax.numpy as jnp

from openjax.evaluation.evaluator import Evaluator, Flown, layout_slots
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Pursuit, PursuitSettings, Task, expand_task, turn_task, uniform_task

VALIDATION_KEY = 20_000_003
"""The validation tasks are drawn from this key in all runs, so that runs can be
compared.
"""

FAR_EXPANSIONS = 20
"""Local expansions that lead to a far task: 0.26 m along each axis in the mean square,
where nothing stops them.
"""


def uniform_tasks(
    settings: PursuitSettings, number: int, slots: int, seed: int = VALIDATION_KEY
) -> Task:
    """The first `number` uniform tasks of a seed, with `slots` pillar slots; by default
    those of the validation.
    """
    keys = jax.random.split(jax.random.key(seed), number)
    tasks = jax.jit(jax.vmap(lambda key: uniform_task(settings, key)))(keys)
    return _with_slots(tasks, slots)


def far_tasks(settings: PursuitSettings, number: int, slots: int) -> Task:
    """The first `number` validation far tasks, with `slots` pillar slots.

    Other uniform tasks, turned about the arena's axis and expanded as those in a
    generator's archive are: starts up to 0.1 m from the arena's wall, and pursuers that
    start apart from each other or around the evader.
    """

    def draw(key):
        uniform_key, turn_key, expand_key = jax.random.split(key, 3)
        task = turn_task(turn_key, uniform_task(settings, uniform_key))
        keys = jax.random.split(expand_key, FAR_EXPANSIONS)

        def expand(task, key):
            return expand_task(settings, key, task), None

        far_task, _ = jax.lax.scan(expand, task, keys)
        return far_task

    # of another key than the uniform ones: no task is in both
    keys = jax.random.split(jax.random.fold_in(jax.random.key(VALIDATION_KEY), 1), number)
    return _with_slots(jax.jit(jax.vmap(draw))(keys), slots)


class ValidationTasks:
    """A run's uniform and as many far tasks, flown in one call of one compiled
    evaluation; it has room for layouts' pillars.

    Args:
      environment: the run's; from its game the tasks are drawn.
      policy: the networks.
      number: tasks of each kind.
      evaders: who flies; none: the game's own.
    """

    def __init__(
        self, environment: Pursuit, policy: Policy, number: int, evaders: tuple[str, ...] = ()
    ):
        settings = environment.settings
        self.number = number
        # drawn by the run's own game, which a wider one would draw otherwise; flown
        # with more slots
        slots = layout_slots(settings)
        game = dataclasses.replace(settings, max_pillars=slots, evaders=evaders or settings.evaders)
        changes = {"evaders": None} if evaders else {}
        wide_game = dataclasses.replace(environment, settings=game, dynamics=None, **changes)
        self.evaluator = Evaluator(wide_game, policy, 2 * number)
        self.tasks: dict[str, Task] = {
            "validation": uniform_tasks(settings, self.number, slots),
            "validation_far": far_tasks(settings, self.number, slots),
        }

    def __call__(self, parameters: PolicyParameters) -> list[Flown]:
        """The uniform and the far tasks, flown."""
        return self.evaluator.fly(parameters, self.tasks, jax.random.key(0))


def selection_score(summary: dict, episode_length: int) -> float:
    """The score that chooses the best checkpoint, on the uniform validation tasks; at most 1.

    Captures and safety come first: a tenth of the episode's length sooner is worth a
    200th of the captures, a 100th of the crashes. The reward isn't asked: how it weighs
    a second stage's smoothness, or a first crash, says how to learn and not what is
    better, and a score that held it would keep the first checkpoints of a policy that
    starts smooth.

    Args:
      summary: from `openjax.evaluation.summarise`.
      episode_length: control steps of an episode; `capture_step` of an episode without
      a capture.
    """
    return (
        summary["capture_rate"]
        - 5.0 * summary["collision_rate"]
        - 0.5 * summary["crash_rate"]
        - 0.1 * summary["over_speed_rate"]
        - 0.05 * summary["capture_step"] / episode_length
    )


def flat_metrics(uniform: dict, far: dict) -> dict[str, float]:
    """Both summaries by name, the far one's with `far_` before it; parts of collisions
    as their own numbers.
    """

    def flat(summary):
        values = {name: value for name, value in summary.items() if not isinstance(value, dict)}
        return values | {
            f"collision_{part}": value for part, value in summary["collision_parts"].items()
        }

    return flat(uniform) | {f"far_{name}": value for name, value in flat(far).items()}


def _with_slots(tasks, slots):
    extra = slots - tasks.pillar_active.shape[-1]
    return tasks.replace(
        pillar_position=jnp.pad(tasks.pillar_position, ((0, 0), (0, extra), (0, 0))),
        pillar_active=jnp.pad(tasks.pillar_active, ((0, 0), (0, extra))),
    )
