"""Another policy in the game of a run, which it wasn't trained for: beside the run's
own it shows what the run was worth.
"""

import dataclasses
from collections.abc import Sequence

import jax

from openjax.evaluation.evaluator import Evaluator, layout_slots, layout_tasks
from openjax.evaluation.validation import uniform_tasks
from openjax.pursuit import Pursuit, Scenario
from openjax.show.trajectory import Trajectory
from openjax.store.policies import LoadedPolicy


def game_for(environment: Pursuit, policy: LoadedPolicy) -> Pursuit:
    """A game for another policy than it was made for, which sees and steers as it was
    trained to; episodes last as long.
    """
    settings = environment.settings
    game = policy.settings.environment
    settings = dataclasses.replace(
        settings.observed_as(game),
        time_step=game.time_step,
        substeps=game.substeps,
        # as many seconds, in steps of its own
        episode_length=round(settings.episode_length * settings.time_step / game.time_step),
        max_pillars=layout_slots(settings),
    )
    return dataclasses.replace(environment, settings=settings, dynamics=None, observer=None)


def compare(
    policy: LoadedPolicy,
    environment: Pursuit,
    scenarios: Sequence[Scenario],
    episodes: int,
    validation: int,
) -> tuple[list[dict], list[Trajectory]]:
    """Fly a policy in the game of a run: `validation` of the uniform validation tasks,
    and layouts.

    Args:
      policy: another one than the run's.
      environment: the run's.
      scenarios: the layouts.
      episodes: of each layout.
      validation: number of tasks.

    Returns:
      records as of `Flown.record`, that of the validation tasks first, their capture
      steps in steps of the run; and the first episode of each.

    Raises:
      UserError: the policy can't play this game.
    """
    game = game_for(environment, policy)
    settings = game.settings
    policy = policy.in_game(game)
    tasks = {"validation": uniform_tasks(environment.settings, validation, settings.max_pillars)}
    tasks |= layout_tasks(settings, scenarios, episodes)
    # all in one batch, which is flown once
    evaluator = Evaluator(game, policy.policy, validation + episodes * len(scenarios))
    kinds = evaluator.fly(policy.parameters, tasks, jax.random.key(0))
    rows = [kind.record() for kind in kinds]
    for row in rows:
        row["capture_step"] *= settings.time_step / environment.settings.time_step
    return rows, [kind.trajectory(0, f"{kind.name}, {policy.source}") for kind in kinds]
