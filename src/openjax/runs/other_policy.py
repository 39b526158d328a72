"""Another policy flown in a run's game. The report shows it beside the policy that the run
trained.
"""

import dataclasses
from collections.abc import Sequence

import jax

from openjax.evaluation.evaluator import Evaluator, layout_slots, layout_tasks
from openjax.evaluation.validation import uniform_tasks
from openjax.pursuit import Pursuit, PursuitSettings, Scenario
from openjax.show.trajectory import Trajectory
from openjax.store.policies import LoadedPolicy, load_policy


def game_for(environment: Pursuit, policy: LoadedPolicy) -> Pursuit:
    """The game as a policy of another one can play it: the policy observes and commands as it
    was trained to, and episodes last as long.
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


@dataclasses.dataclass(frozen=True)
class OtherPolicy:
    """A policy in the game of a run, see `other_policy`."""

    policy: LoadedPolicy
    environment: Pursuit
    """The game as this policy sees it and steers in it."""
    run: PursuitSettings
    """Settings of the run's own game."""

    def fly(
        self, scenarios: Sequence[Scenario], episodes: int, validation: int
    ) -> tuple[list[dict], list[Trajectory]]:
        """Fly `validation` of the run's uniform validation tasks, and `episodes` of each layout.

        Returns:
          records as of `Flown.record`, that of the validation tasks first, their capture
          steps in steps of the run; and the first episode of each.
        """
        settings = self.environment.settings
        tasks = {"validation": uniform_tasks(self.run, validation, settings.max_pillars)}
        tasks |= layout_tasks(settings, scenarios, episodes)
        # all in one batch, which is flown once
        number = validation + episodes * len(scenarios)
        evaluator = Evaluator(self.environment, self.policy.policy, number)
        kinds = evaluator.fly(self.policy.parameters, tasks, jax.random.key(0))
        rows = [kind.record() for kind in kinds]
        for row in rows:
            row["capture_step"] *= settings.time_step / self.run.time_step
        titles = [f"{kind.name}, {self.policy.source}" for kind in kinds]
        return rows, [kind.trajectory(0, title) for kind, title in zip(kinds, titles, strict=True)]


def other_policy(name: str, environment: Pursuit) -> OtherPolicy:
    """The policy of that name in the game of a run. Raises UserError where it can't play it."""
    policy = load_policy(name)
    game = game_for(environment, policy)
    return OtherPolicy(policy.in_game(game), game, environment.settings)
