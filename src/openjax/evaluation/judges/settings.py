"""Settings of the judges, without JAX, so that a command's help comes at once."""

from dataclasses import dataclass
from typing import Annotated

from openjax.errors import UserError
from openjax.learning.settings import PlanSettings
from openjax.ranges import Interval, check_intervals


@dataclass(frozen=True)
class BestResponseSettings:
    """Settings of evaders that learn against fixed pursuers."""

    learners: Annotated[int, Interval("[1, 64]")] = 4
    """Evaders that learn side by side: of two widths, each in the world's axes and in
    its own.
    """
    total_steps: Annotated[int, Interval("[1, 1e15]")] = 6_000_000_000
    """Environment steps of all learners."""
    looks: Annotated[tuple[int, ...], Interval("[1, 1e15]")] = (
        100_000_000,
        250_000_000,
        500_000_000,
        1_000_000_000,
    )
    """Steps of each learner after which all are kept and fly later, as they do at the
    end: how well a policy holds is a curve over what its attacker spends.
    """
    num_envs: Annotated[int, Interval("[1, 16777216]")] = 4096
    """Worlds of each learner."""
    hold: Annotated[int, Interval("[1, 1000]")] = 4
    """Control steps for which a decision is flown: 40 ms, in which an evader moves 5
    cm.
    """
    ways: Annotated[int, Interval("[1, 64]")] = 6
    """Velocities of which a decision chooses one: where left and right are equally
    good, the mean of a single one leads into the middle.
    """
    widths: Annotated[tuple[int, ...], Interval("[1, 4096]")] = (256, 128)
    """Width of both hidden layers, of learner after learner: 100 numbers are sensed,
    and two layers of 64 gave evaders that ran into corners.
    """
    rollout_length: Annotated[int, Interval("[1, 100000]")] = 16
    """Decisions per iteration: two thirds of a second of the game."""
    foresight: tuple[float, ...] = (4.0,)
    """Seconds after which what comes counts 1/e, of learner after learner: traps take
    one to three.
    """
    gae_lambda: Annotated[float, Interval("[0, 1]")] = 0.95
    """Lambda of the generalised advantage estimate."""
    learning_rate: Annotated[float, Interval("(0, 1]")] = 7e-4
    """Adam step size at the start; falls linearly to zero."""
    epochs: Annotated[int, Interval("[1, 1000]")] = 3
    """Passes over each iteration's rollouts."""
    minibatches: Annotated[int, Interval("[1, 100000]")] = 16
    """Gradient steps of one pass: with four, learners come to .972 to .978 of the
    longest time in a game whose answer is known, with sixteen and six ways to .991
    (`tests.learning.known_games`).
    """
    clip_epsilon: Annotated[float, Interval("(0, 10]")] = 0.2
    """Clip range of the probability ratio."""
    entropy_coefficient: Annotated[float, Interval("[0, 10]")] = 2e-3
    """Weight of the entropy."""
    value_coefficient: Annotated[float, Interval("(0, 1000]")] = 10.0
    """Weight of the squared error of values, which are at most one."""
    initial_log_std: Annotated[float, Interval("[-10, 2]")] = 0.0
    """Start of the log standard deviation of a decision."""
    least_log_std: Annotated[float, Interval("[-10, 2]")] = -2.5
    """Least log standard deviation, so that exploring doesn't end."""
    layouts: Annotated[float, Interval("[0, 1]")] = 0.5
    """Share of the episodes that begin among a layout's pillars, turned and with starts
    moved; the others are uniform tasks, turned.
    """

    specialists: Annotated[int, Interval("[0, 64]")] = 0
    """Of the learners, how many learn on one layout each, in turn, and now and then on
    uniform tasks: a learner of all six sees little of each.
    """

    def __post_init__(self):
        check_intervals(self)
        if self.specialists > self.learners:
            raise UserError(
                f"specialists {self.specialists}: at most the {self.learners} learners can be some"
            )
        if not self.widths:
            raise UserError("widths: at least one number is needed")
        if not self.foresight or min(self.foresight) <= 0.0:
            raise UserError(f"foresight {self.foresight}: seconds above zero are needed")
        if self.num_envs * self.rollout_length % self.minibatches:
            raise UserError(
                f"num_envs {self.num_envs} times rollout_length {self.rollout_length} must be a "
                f"multiple of minibatches {self.minibatches}"
            )

    @property
    def steps_per_update(self) -> int:
        """Environment steps of an iteration, of all learners."""
        return self.learners * self.num_envs * self.rollout_length * self.hold

    @property
    def total_updates(self) -> int:
        """Iterations of the run."""
        return max(1, -(-self.total_steps // self.steps_per_update))

    @property
    def updates_of_looks(self) -> list[int]:
        """Iterations after which learners are kept, those of the run's end among
        them.
        """
        steps = self.steps_per_update // self.learners
        updates = {max(1, round(look / steps)) for look in self.looks}
        total = self.total_updates
        return sorted({update for update in updates if update < total} | {total})

    def width_of(self, learner: int) -> int:
        """Of its hidden layers."""
        return self.widths[learner % len(self.widths)]

    def sees_in_world(self, learner: int) -> bool:
        """True if it sees in the world's axes; of four learners of two widths each
        width does both.
        """
        return (learner + learner // len(self.widths)) % 2 == 1

    @property
    def gradient_steps(self) -> int:
        """Of each learner in the whole run."""
        return self.total_updates * self.epochs * self.minibatches

    def discounts(self, time_step: float) -> list[float]:
        """Of a decision, of each learner; `time_step` of the game in seconds."""
        decision = self.hold * time_step
        seconds = (self.foresight[i % len(self.foresight)] for i in range(self.learners))
        return [1.0 - decision / (decision + second) for second in seconds]


@dataclass(frozen=True)
class PlannerSettings(PlanSettings):
    """Settings of an evader that plans."""

    replan: Annotated[int, Interval("[1, 1000]")] = 10
    """Control steps after which it plans anew."""
    learned_value: bool = False
    """True if a second planner flies, to which the end of a plan is worth as many steps
    as the strongest of those that learned would be free from there, by its own
    estimate.
    """
