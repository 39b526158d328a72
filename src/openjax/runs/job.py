"""A training run: settings, own parts, where it starts and how long it may last.
`openjax.runs.training` runs it.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from openjax.baselines import Heuristic
from openjax.cluster.devices import check_devices, check_memory
from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.learning import Learner, Parts, TrainSettings
from openjax.policy import Network, Policy, PolicyParameters
from openjax.policy.growth import in_larger_game
from openjax.pursuit import Pursuit
from openjax.runs.other_policy import OtherPolicy
from openjax.runs.train_command import TrainCommand
from openjax.store.leaves import named_leaves
from openjax.store.mixed_policies import member
from openjax.store.policies import abstract_parameters, load_policy
from openjax.store.policy_files import fill


@dataclasses.dataclass(frozen=True)
class OwnParts:
    """The parts that were passed in from Python; see `openjax.learning.build`. A resumed run takes
    the same parts again.
    """

    environment: Pursuit | None = None
    """A game of one's own, with its evaders, reward, observations; its settings go before
    those of the run.
    """
    policy: Policy | Network | None = None
    """A network of one's own (`openjax.policy.Network`), or a whole policy."""
    learners: Mapping[str, Learner] | None = None
    """Learners of one's own by name (`openjax.learning.Learner`), beside the shipped ones, or
    in the place of `predictor`, `evaders` or `policy`, which is MAPPO.
    """
    on_record: Callable[[dict], Any] | None = None
    """Called with each record of `metrics.jsonl` once it is written: event (train or
    validation), update, steps, seconds and numbers by name. `wandb.log` takes it.
    """

    @property
    def names(self) -> list[str]:
        """The names of own parts: a run that began with them continues with the same ones only."""
        parts = [name for name in ("environment", "policy", "learners") if getattr(self, name)]
        return parts + [f"learner {name}" for name in self.learners or ()]


@dataclasses.dataclass(frozen=True)
class TrainingJob:
    """The training to do, and its conditions."""

    command: TrainCommand
    """The request, with what the machine or a resumed run adds to it."""
    parts: Parts
    """Environment, policy and learners."""
    own_parts: OwnParts
    """The parts that were given in Python."""
    devices: int
    """Of all processes together."""
    processes: Processes
    start: PolicyParameters | None
    """Networks that the run starts with; None: fresh ones, or those of a checkpoint."""
    other: OtherPolicy | None
    """The policy that the report shows beside the trained one."""
    facts: dict
    """Kept beside the settings: command line, machine."""
    began: float
    """`time.monotonic()` when the command started."""
    traced: Path | None = None
    """Folder in which traced programs are kept; None: they aren't."""

    @property
    def settings(self) -> TrainSettings:
        """Everything that determines the run."""
        return self.command.settings

    @property
    def time_limit(self) -> float:
        """Seconds of learning after which to stop; compiling comes before."""
        minutes = self.command.minutes
        return float("inf") if minutes is None else 60.0 * minutes


def check_job(job: TrainingJob) -> None:
    """Raises UserError for what doesn't fit together, before any directory is touched."""
    settings = job.settings
    if settings.environment.strategies != 1:
        raise UserError(
            f"--environment.strategies {settings.environment.strategies}: train the members of a "
            "team one by one, then join them with openjax mix"
        )
    check_devices(settings, job.devices)
    check_memory(settings, job.devices)
    if job.own_parts.policy is not None and (
        settings.first_flights.updates or settings.analytic.updates
    ):
        raise UserError(
            "first_flights.updates and analytic.updates must be 0 for a network of your "
            "own: these stages need the shipped ones"
        )


def start_parameters(name: str, settings: TrainSettings, parts: Parts) -> PolicyParameters:
    """Those of the policy of that name, for a run with these settings and parts; without
    a critic where it has none, or one of another game.

    Raises:
      UserError: it isn't there, or its networks don't fit.
    """
    # of a team that draws, the first one learns on: members learn by themselves
    start_policy = member(load_policy(name), 0)
    if isinstance(start_policy.policy, Heuristic):
        raise UserError(f"--start_from {name}: a heuristic has no networks to start from")
    game = start_policy.settings.environment
    axes = settings.environment.observe_in
    # of the same shapes, so that nothing else would tell
    if axes != game.observe_in:
        raise UserError(
            f"--start_from {name}: it observes in {game.observe_in}, the run in {axes} "
            "(--environment.observe_in)"
        )
    old = in_larger_game(
        start_policy.parameters, start_policy.settings.predictor, game, settings.environment
    )
    fresh = abstract_parameters(parts.environment, parts.policy)
    leaves = named_leaves(old.replace(critic={}))
    actor = fill(fresh.replace(critic={}), leaves, f"--start_from {name}")
    # a critic may see other numbers in another game; it is learnt anew sooner than an actor
    fits = jax.tree.map(jnp.shape, old.critic) == jax.tree.map(jnp.shape, fresh.critic)
    return actor.replace(critic=old.critic if fits else {})
