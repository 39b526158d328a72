"""Another policy in a run's layouts and validation tasks: what a table needs to show how much is left to learn."""

import dataclasses
from collections.abc import Sequence

import jax

from openjax.commands.evaluator import Evaluator, layout_slots, layout_tasks
from openjax.commands.validation import uniform_tasks
from openjax.pursuit import Pursuit, PursuitSettings, Scenario
from openjax.show.trajectory import Trajectory
from openjax.store.policies import LoadedPolicy

_OF_THE_POLICY = (
    "time_step",
    "substeps",
    "observed_pillars",
    "observe_time",
    "observe_position",
    "observe_history",
    "observe_history_spacing",
    "history_length",
    "history_spacing",
)
"""Settings that are how a policy sees and steers, and not what game it plays."""


def game_for(settings: PursuitSettings, policy: LoadedPolicy) -> PursuitSettings:
    """The game of `settings` for another policy, which sees and steers as it was trained to; episodes last as long."""
    own = policy.settings.environment
    return dataclasses.replace(
        settings,
        **{name: getattr(own, name) for name in _OF_THE_POLICY},
        episode_length=round(settings.episode_length * settings.time_step / own.time_step),
        max_pillars=layout_slots(settings),
    )


def compare(
    policy: LoadedPolicy, environment: Pursuit, scenarios: Sequence[Scenario], episodes: int, validation: int
) -> tuple[list[dict], list[Trajectory]]:
    """Fly a policy in the game of a run: `validation` of the uniform validation tasks, and layouts.

    Args:
      policy: another one than the run's.
      environment: the run's.
      scenarios: the layouts.
      episodes: of each layout.
      validation: number of tasks.

    Returns:
      records as of `Flown.record`, that of the validation tasks first, their capture steps in steps of the run; and
      the first episode of each.

    Raises:
      UserError: the policy can't play this game.
    """
    settings = game_for(environment.settings, policy)
    game = dataclasses.replace(environment, settings=settings, dynamics=None)
    policy = policy.in_game(game)
    tasks = {"validation": uniform_tasks(environment.settings, validation, settings.max_pillars)}
    tasks |= layout_tasks(settings, scenarios, episodes)
    evaluator = Evaluator(game, policy.policy, validation + episodes * len(scenarios))
    flown = evaluator.fly(policy.parameters, tasks, jax.random.key(0))
    longer = settings.time_step / environment.settings.time_step
    rows = [row | {"capture_step": longer * row["capture_step"]} for row in (kind.record() for kind in flown)]
    return rows, [kind.trajectory(0, f"{kind.name}, {policy.source}") for kind in flown]
