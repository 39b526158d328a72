"""What a training run is made of: settings, own parts, where it starts and how long it
may last. `openjax.runs.training` goes about it.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from openjax.baselines import Heuristic
from openjax.cluster.devices import check_devices, check_memory
from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.learning import Learner, Parts, TrainSettings, build
from openjax.policy import Network, Policy, PolicyParameters
from openjax.policy.growth import with_longer_history
from openjax.pursuit import Pursuit
from openjax.runs.other_policy import game_for
from openjax.store.leaves import named_leaves
from openjax.store.mixed_policies import member
from openjax.store.policies import abstract_parameters, load_policy
from openjax.store.policy_files import fill
from openjax.store.traced_programs import recall


@dataclasses.dataclass(frozen=True)
class OwnParts:
    """Parts of a run that were handed in from Python; see `openjax.learning.build`."""

    environment: Pursuit | None = None
    policy: Policy | Network | None = None
    learners: Mapping[str, Learner] | None = None

    @property
    def names(self) -> list[str]:
        """What they are: a run that was begun with them goes on with the same ones
        only.
        """
        parts = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        return parts + [f"learner {name}" for name in self.learners or ()]


ALL_SHIPPED = OwnParts()


@dataclasses.dataclass(frozen=True)
class TrainingJob:
    """What to train and how to go about it."""

    settings: TrainSettings
    environment: Pursuit
    start_from: str | None
    """Policy whose networks the run starts with."""
    devices: int
    """Of all processes together."""
    processes: Processes
    time_limit: float
    """Seconds of learning after which to stop; compiling comes before."""
    layout_episodes: int
    compare_with: str | None
    """Policy that the report shows beside the trained one."""
    facts: dict
    """Kept beside the settings: command line, machine."""
    started: float
    """`time.monotonic()` when the command started."""
    traced: Path | None = None
    """Folder in which traced programs are kept; None: they aren't."""
    own: OwnParts = ALL_SHIPPED

    @functools.cached_property
    def parts(self) -> Parts:
        """Environment, policy and learners."""
        return build(self.settings, self.environment, self.own.policy, self.own.learners)

    @property
    def made_from(self) -> str:
        """What the run's programs depend on, beside the package's sources; the seed
        comes in as a key.
        """
        game = self.environment
        settings = dataclasses.replace(self.settings, seed=0)
        # numbers that are written into the programs as constants
        leaves = jax.tree.leaves((game.vehicle, game.effect_parameters))
        arrays = [np.asarray(leaf).tolist() for leaf in leaves]
        names = str(jax.tree.structure(game.effect_parameters))
        return repr((self.devices, settings, game.settings, game.effects, names, arrays))

    @property
    def keep(self) -> Callable | None:
        """`recalled` for the run's programs; None where traces aren't kept, or where
        functions of one's own are in them, whose text nobody knows.
        """
        game = self.environment
        if self.traced is None or self.own.names or game.evaders or game.reward or game.observer:
            return None
        return functools.partial(recall, made_from=self.made_from, folder=self.traced)

    def check(self) -> None:
        """Raises UserError for what doesn't fit together, before any directory is
        touched.
        """
        if self.settings.environment.strategies != 1:
            raise UserError(
                f"--environment.strategies {self.settings.environment.strategies}: the members of "
                "a team that draws are trained one by one, then openjax mix makes one of them"
            )
        check_devices(self.settings, self.devices)
        check_memory(self.settings, self.devices)
        if self.start_from is not None:
            abstract = abstract_parameters(self.environment, self.parts.policy)
            start_parameters(self, abstract)
        if self.compare_with is not None:
            other = load_policy(self.compare_with)
            other.in_game(game_for(self.environment, other))
        if self.own.policy is not None:
            stages = self.settings.first_flights.updates or self.settings.analytic.updates
            if stages:
                raise UserError(
                    "first_flights.updates and analytic.updates must be 0 for a policy of one's "
                    "own: these stages need the shipped networks"
                )


def start_parameters(job: TrainingJob, fresh: PolicyParameters) -> PolicyParameters:
    """Those of the policy that the run starts from; `fresh` ones where it has no
    critic, or one of another game.
    """
    # of a team that draws, the first one learns on: members learn by themselves
    start_policy = member(load_policy(job.start_from), 0)
    if isinstance(start_policy.policy, Heuristic):
        raise UserError(f"--start_from {job.start_from}: a heuristic has no networks to start from")
    settings = start_policy.settings
    axes = job.settings.environment.observe_in
    policy_axes = settings.environment.observe_in
    # of the same shapes, so that nothing else would tell
    if axes != policy_axes:
        raise UserError(
            f"--start_from {job.start_from}: it observes in {policy_axes}, the run in {axes} "
            "(--environment.observe_in)"
        )
    old = with_longer_history(
        start_policy.parameters, settings.predictor, settings.environment, job.settings.environment
    )
    leaves = named_leaves(old.replace(critic={}))
    leaves_filled = fill(fresh.replace(critic={}), leaves, f"--start_from {job.start_from}")
    # a critic may see other numbers in another game; it is learnt anew sooner than an
    # actor
    fits = jax.tree.map(jnp.shape, old.critic) == jax.tree.map(jnp.shape, fresh.critic)
    return leaves_filled.replace(critic=old.critic if fits else fresh.critic)
