"""Settings of a training run."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

from openjax.errors import UserError
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import PursuitSettings
from openjax.ranges import Interval, Seed, check_intervals

if TYPE_CHECKING:
    # written in JAX, which a command's help needn't wait for
    from openjax.learning.schedule import Schedule


@dataclass(frozen=True)
class MappoSettings:
    """Multi-agent PPO with a shared actor."""

    learning_rate: Annotated[float, Interval("(0, 1]")] = 5e-4
    """Adam step size at the start; falls linearly to zero over `total_steps`."""
    actor_start: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the run before the actor begins to learn: a run that starts from a
    policy without its critic learns that first.
    """
    EPOCHS = 4
    """Passes over each iteration's rollouts."""
    minibatches: Annotated[int, Interval("[1, 100000]")] = 16
    """Gradient steps of one pass, each on as many worlds."""
    step_subsampling: Annotated[int, Interval("[1, 100000]")] = 1
    """A gradient step sees every n-th step of its trajectories, from a first one drawn
    each time: consecutive steps are so alike that fewer of them teach nearly as much.
    Divides `rollout_length`.
    """
    clip_epsilon: Annotated[float, Interval("(0, 10]")] = 0.1
    """Clip range of the probability ratio at the start of the run."""
    clip_epsilon_end: Annotated[float, Interval("(0, 10]")] = 0.1
    """Clip range at the end of the run, to which it changes linearly."""
    target_kl: Annotated[float, Interval("[0, 10]")] = 0.0
    """Divergence (nats) of the learning policy from the one that flew, near which the
    actor's step size keeps it; 0: steps aren't scaled. A run that starts from a policy
    with little noise needs it.
    """
    entropy_coefficient: Annotated[float, Interval("[0, 10]")] = 1e-3
    """Weight of the entropy."""
    discount: Annotated[float, Interval("[0, 1]")] = 0.995
    """Of the reward, per control step."""
    gae_lambda: Annotated[float, Interval("[0, 1]")] = 0.95
    """Lambda of the generalised advantage estimate."""
    MAX_GRAD_NORM = 10.0
    """Global norm to which gradients are cut, actor and critic each."""
    HUBER = 10.0
    """The error at which the value loss turns linear, in standard deviations of the returns."""
    VALUE_COEFFICIENT = 1.0
    """Weight of the value loss; it matters where actor and critic share an encoder."""
    VALUE_NORM_DECAY = 0.95
    """Share of the old mean and variance of the returns that value normalisation keeps
    per iteration.
    """
    REWARD_SCALE = 0.1
    """By which rewards are multiplied before they are learnt from."""
    penalty_start: Annotated[float, Interval("[0, 1]")] = 1.0
    """Share of the penalties (collision, speed, crash) that counts at the start of the
    run.
    """
    penalty_ramp: Annotated[float, Interval("[0, 1]")] = 0.5
    """Share of the run over which the penalties rise linearly to their whole size."""

    def __post_init__(self):
        check_intervals(self, "mappo.")


@dataclass(frozen=True)
class GeneratorSettings:
    """The adaptive environment generator."""

    enabled: bool = True
    """Draw tasks from the archive of unsolved ones; False: uniform tasks only."""
    capacity: Annotated[int, Interval("[1, 10000000]")] = 5000
    """Tasks in the archive."""
    PILLAR_SHIFT = 0.1
    """Pillars of uniform tasks are moved by up to this along x and y (m), off the grid
    on which the paper's stand.
    """
    row_share: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the uniform tasks whose pillars stand in a row between the two sides
    (none of the paper's).
    """
    expansion: Annotated[float, Interval("[0, 1]")] = 0.7
    """Probability p of local expansion of an archived task, else a uniform one."""
    success_low: Annotated[float, Interval("[0, 1]")] = 0.5
    """Least success rate of a task that enters the archive."""
    success_high: Annotated[float, Interval("[0, 1]")] = 0.9
    """Largest success rate of a task that enters the archive."""
    wall_distance: Annotated[float, Interval("[0, 10]")] = 0.1
    """Expanded starts keep this far from the arena's wall (m); 0.1 in the released
    code.
    """
    episodes_per_task: Annotated[int, Interval("[1, 100000]")] = 4
    """Environments that share one task, so that its success rate can be told."""
    collision_tolerance: Annotated[float, Interval("(0, 1]")] = 1.0
    """An episode counts as success if it captures and its collision rate stays below
    this (1: capture alone), once the penalties count in full; before that, more is
    tolerated (this to the power of the penalties' share).
    """

    FORMER = MappingProxyType({"turn": True})
    """Settings that earlier versions had, and their only value now."""

    def __post_init__(self):
        check_intervals(self, "generator.")
        if self.success_low > self.success_high:
            raise UserError(
                f"generator.success_low {self.success_low} is more than generator.success_high "
                f"{self.success_high}"
            )


@dataclass(frozen=True)
class EvaderLearningSettings:
    """PPO of evaders that learn; see `openjax.learning.learners.evasion`."""

    past: Annotated[int, Interval("[0, 64]")] = 0
    """Number of a game's learned evaders, the last ones, that are earlier selves of the
    others: who only meets the newest ones unlearns what beat the older ones.
    """

    LEARNING_RATE = 1e-3
    """Adam step size at the start of the run."""
    LEARNING_RATE_END = 1e-4
    """Adam step size at the end of the run, to which it falls linearly."""
    EPOCHS = 3
    """Passes over each iteration's rollouts."""
    MINIBATCHES = 4
    """Gradient steps of one pass."""
    CLIP_EPSILON = 0.2
    """Clip range of the probability ratio (Schulman et al. 2017, arXiv 1707.06347)."""
    ENTROPY_COEFFICIENT = 1e-3
    """Weight of the entropy."""
    HOLD = 4
    """Control steps for which a decision is flown while it is learnt; divides
    `rollout_length`. Noise that is new in each step averages out before an evader has
    moved 2 cm.
    """
    DISCOUNT = 0.99
    """Of a decision: where one holds for 40 ms, it sees 4 s ahead. A trap takes one to
    three.
    """
    GAE_LAMBDA = 0.95
    """Lambda of the generalised advantage estimate (Schulman et al. 2016, arXiv
    1506.02438).
    """
    INITIAL_LOG_STD = -0.5
    """Start of the log standard deviation of the evaders' decisions, as the pursuers'."""
    POOL = 32
    """Earlier networks that are kept, from which earlier selves are drawn."""
    POOL_EVERY = 10
    """Updates after which one of the kept networks is replaced, and all earlier selves
    are drawn again.
    """
    FORMER = MappingProxyType({"own_axes": False})
    """Settings that earlier versions had, and their only value now."""

    def __post_init__(self):
        check_intervals(self)


@dataclass(frozen=True)
class FirstFlightsSettings:
    """The stage before MAPPO by the gradient through the simulation; see
    `openjax.learning.gradient.first_flights`.

    Its numbers were tuned for the preset `quick`. A crash is felt from afar, so that
    pursuers go round rows of pillars and don't try gaps under half a metre.
    """

    updates: Annotated[int, Interval("[0, 1000000]")] = 0
    """Updates of the actor; 0: there is no such stage."""
    SWITCH = "updates"
    """Earlier versions wrote other numbers for a stage that isn't there."""
    WORLDS = 128
    """Worlds that are simulated at once."""
    TIME_STEP = 0.04
    """Control step (s): longer ones than the game's teach as much in fewer."""
    STEPS = 20
    """Control steps that are learnt at once."""
    LEARNING_RATE = 2e-3
    """Adam step size at the start; falls to a twentieth."""
    ANEW = 0.15
    """Share of the worlds that restart after each update, beside those that have to."""
    DISTANCE = 3.0
    """Weight of the nearest pursuer's mean way to the evader (m). What is minimised is
    this, the share of the time in which the evader is free, and what follows.
    """
    CRASH = 30.0
    """Weight, at the end of the stage, of the share of pursuers that touch something or
    tip over.
    """
    CRASH_SMOOTH = 0.05
    """Distance (m) over which a touch counts from all to none: a longer one is felt
    earlier, and closes narrower ways.
    """
    BREACH = 4.0
    """Weight, at the end of the stage, of the mean number of breaches."""
    SPEED = 1.0
    """Weight of speeds over the limit."""
    PENALTY_START = 0.2
    """Share of the weights of crashes and breaches at the start: who fears them then
    stays away from the evader.
    """
    PENALTY_FREE = 0.62
    """Share of the time below which the evader must be free in an update for these
    weights to rise in it, and for tips over to begin to count.
    """
    PENALTY_RAMP = 0.4
    """Share of the stage's updates that must be such until the weights are whole."""

    def __post_init__(self):
        check_intervals(self, "first_flights.")


@dataclass(frozen=True)
class AnalyticSettings:
    """The stage after MAPPO by the gradient through the simulation; see
    `openjax.learning.gradient.last_flights`.
    """

    updates: Annotated[int, Interval("[0, 1000000]")] = 0
    """Updates of the actor; 0: there is no such stage."""
    look_every: Annotated[int, Interval("[1, 1000000]")] = 200
    """Updates between validations; the best of all is kept, what it was before among
    them.
    """
    worlds: Annotated[int, Interval("[1, 65536]")] = 640
    """Starts in an update, and as many moments of flights."""
    learning_rate: Annotated[float, Interval("(0, 1]")] = 3e-4
    """Adam step size at the start; falls linearly to a twentieth."""
    hold: Annotated[float, Interval("[0, 1000]")] = 0.04
    """Weight of the squared change of the actions in flight, in standard deviations of
    the policy's.
    """

    DRAWS = 4
    """The ratio of starts flown to starts learnt from, which are the hardest."""
    BREACH = 2.0
    """Weight of the breaches per step in flight, beside the share of pursuers that
    touch something from a start; see `team_weight`.
    """
    SPEED = 0.6
    """Weight of speeds over the limit in flight; see `team_weight`."""
    SPEED_FROM = 0.97
    """Share of the maximal speed from which the speed costs."""
    NOMINAL = 0.25
    """Share of the worlds whose vehicles are nominal ones instead of the family's."""
    FORMER = MappingProxyType({"breach": {2.0, 5.3}, "speed": {0.6, 1.6}})
    """Earlier versions wrote weights for teams of eight slots out."""

    def __post_init__(self):
        check_intervals(self, "analytic.")


@dataclass(frozen=True)
class WorstPlansSettings:
    """The last stage's lessons from evaders' plans; see `openjax.learning.gradient.worst_plans`."""

    worlds: Annotated[int, Interval("[0, 65536]")] = 0
    """Worlds in which an evader plans; 0: the last stage has none of them."""

    SWITCH = "worlds"
    """Earlier versions wrote other numbers where no evader plans."""
    PLANS = 32
    """Plans that each evader tries."""
    PIECES = 6
    """Velocities of a plan, one after the other."""
    PIECE_SECONDS = 0.2
    """For how long each is flown (s). After plans of .8 s a planner got away in .42 of
    `random`, after these of 1.2 s in .16.
    """
    DISTANCE = 1.0
    """Weight of the nearest pursuer's mean path to the evader (m), beside the share of
    the plan in which it is free.
    """
    UNSEEN = 1.0
    """Weight of how well the evader hides from all of them, beside the same."""
    TEAM_PLANS = 48
    """Plans of the whole team that are tried against evaders' plans, by points, to show
    pursuers what they could do; teams of several sizes try none, as points know of no
    empty slots.
    """
    FOLLOW = 3.0
    """Weight of how far pursuers are from where the best of these leads (m)."""
    CRASH = 8.0
    """Weight of the share of pursuers that touch something, beside the same; see
    `team_weight`.
    """
    BREACH = 2.0
    """Weight of the breaches per step, beside the same; see `team_weight`."""
    HOLD_UNSEEN = 0.02
    """As `analytic.hold`, where nobody sees the evader: nothing is learnt there, and
    what was is held; see `team_weight`.
    """
    FORMER = MappingProxyType(
        {
            "territory": 0.0,
            "team_plans": {0, 48},
            "crash": {8.0, 21.0},
            "breach": {2.0, 5.3},
            "hold_unseen": {0.02, 0.053},
        }
    )
    """Settings that earlier versions had, and weights that they wrote out for teams of
    eight slots.
    """

    def __post_init__(self):
        check_intervals(self, "worst_plans.")


@dataclass(frozen=True)
class PlanSettings:
    """The plans that an evader tries; see `openjax.learning.plan_search`."""

    plans: Annotated[int, Interval("[3, 10000]")] = 48
    """That are tried each time."""
    pieces: Annotated[int, Interval("[1, 100]")] = 4
    """Velocities of a plan, one after the other."""
    piece_steps: Annotated[int, Interval("[1, 1000]")] = 20
    """Control steps of each velocity: .2 s, so that four see .8 s ahead."""
    ahead: Annotated[float, Interval("[0, 10]")] = 0.15
    """Seconds after which pursuers are thought to be where their velocity leads, at a
    plan's end: about the time in which a vehicle turns its velocity round.
    """
    turn: Annotated[float, Interval("[0, 1]")] = 0.5
    """Odds that a piece of a random plan leads elsewhere than the piece before."""
    refined: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the plans that are the last best one with some pieces flown a little
    otherwise.
    """
    own_rule: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the random plans that turn after whose first pieces, or none, the evader
    flies as the strongest of those that learned: it knows what comes after the horizon.
    """

    def __post_init__(self):
        check_intervals(self, "planning.")

    @property
    def steps(self) -> int:
        """Control steps of a plan."""
        return self.pieces * self.piece_steps


@dataclass(frozen=True)
class AdaptSettings:
    """Settings of fine-tuning a policy."""

    worlds: Annotated[int | None, Interval("[1, 65536]")] = None
    """Worlds of each kind of flight in an update; by default 320 on an accelerator, 8
    on a CPU: enough to see it work.
    """
    updates: Annotated[int, Interval("[1, 1000000]")] = 120
    """Updates of the actor."""
    look_every: Annotated[int, Interval("[1, 1000000]")] = 40
    """Updates between evaluations of the policy; the best of all is kept."""
    learning_rate: Annotated[float, Interval("(0, 1]")] = 3e-4
    """Adam step size at the start; falls linearly to a twentieth."""
    follow: Annotated[float, Interval("[0, 1000]")] = 0.1
    """Weight of flying where the nominal vehicle would, beside the share of pursuers
    that touch something.
    """

    def __post_init__(self):
        check_intervals(self, "training.")


@dataclass(frozen=True)
class TrainSettings:
    """Everything that determines a run. A run's result depends on nothing else but the
    machine's arithmetic.
    """

    environment: PursuitSettings = field(default_factory=PursuitSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    predictor: PredictorSettings = field(default_factory=PredictorSettings)
    mappo: MappoSettings = field(default_factory=MappoSettings)
    generator: GeneratorSettings = field(default_factory=GeneratorSettings)
    first_flights: FirstFlightsSettings = field(default_factory=FirstFlightsSettings)
    analytic: AnalyticSettings = field(default_factory=AnalyticSettings)
    worst_plans: WorstPlansSettings = field(default_factory=WorstPlansSettings)
    evader_learning: EvaderLearningSettings = field(default_factory=EvaderLearningSettings)
    num_envs: Annotated[int, Interval("[1, 16777216]")] = 2560
    """Worlds that are simulated at once."""
    rollout_length: Annotated[int, Interval("[1, 100000]")] = 80
    """Control steps per iteration; divides the episode's length, so that episodes end
    between rollouts.
    """
    total_steps: Annotated[int, Interval("[1, 1e15]")] = 400_000_000
    """Environment steps of the run (one step moves one world, all its pursuers)."""
    restart_every: Annotated[int, Interval("[0, 100000]")] = 0
    """The worlds of every n-th task are started anew after `restart_steps` already, so
    that more is learnt of starts, the hardest part of an episode; 0: none are.
    """
    restart_steps: Annotated[int, Interval("[1, 100000]")] = 160
    """Multiple of `rollout_length`; the value of what would have come is estimated, as
    after every rollout.
    """
    restart_close: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the pursuers in worlds that are started anew which start close to a
    pillar or another pursuer.
    """
    vehicles_start: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the run, at its start, in which all vehicles are nominal."""
    vehicles_ramp: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the run after that over which the family `environment.vehicles` grows
    about the nominal vehicle to its whole size.
    """
    evaders_start: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the run, at its start, in which all evaders are the first of
    `environment.evaders`.
    """
    evaders_ramp: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the run after that over which the others come in, slow ones first, until
    they have their whole odds and speed.
    """
    validation_interval: Annotated[int, Interval("[1, 1000000]")] = 50
    """Iterations between validations, on uniform tasks that are never trained on."""
    validation_episodes: Annotated[int, Interval("[1, 1000000]")] = 256
    """Uniform tasks that are never trained on, and as many far ones."""
    seed: Seed = 0
    """Draws the networks' first parameters, the tasks and the exploration."""

    VALIDATION_EVADERS = ("field", "heavy", "pillar_hugger")
    """Evaders of the validation where some of the training's learn: others each time, they
    aren't comparable.
    """
    FORMER = MappingProxyType(
        {"validation_start": {0.0, 1.0}, "evaders_validation": {(), VALIDATION_EVADERS}}
    )
    """Settings that earlier versions had; of these the evaders decide now."""

    def __post_init__(self):
        check_intervals(self)
        for holds, text in self._demands():
            if not holds:
                raise UserError(text)

    def _demands(self):
        """Conditions between settings: if each holds, and the message if it doesn't."""
        yield from self._demands_of_worlds()
        yield from self._demands_of_teams()
        yield from self._demands_of_evaders()
        yield from self._demands_of_learners()

    def _demands_of_worlds(self):
        """Episodes, start groups and tasks share out rollouts and worlds evenly."""
        length = self.environment.episode_length
        rollout = self.rollout_length
        yield (
            length % rollout == 0,
            f"rollout_length {rollout} must divide environment.episode_length {length}",
        )
        unit = self.world_unit
        yield (
            self.num_envs % unit == 0,
            f"num_envs {self.num_envs} must be a multiple of {unit} (start groups times episodes "
            "per task" + (", times restart_every)" if self.restart_every else ")"),
        )
        # with 1 all worlds would start anew in their middle, and no episode would be
        # whole
        yield (self.restart_every != 1, "restart_every is 1; 0 (never) or at least 2 are possible")
        yield (
            self.restart_steps >= rollout and self.restart_steps % rollout == 0,
            f"restart_steps {self.restart_steps} must be a multiple of rollout_length {rollout}",
        )
        yield (
            self.restart_every or not self.restart_close,
            f"restart_close {self.restart_close} needs restart_every; without it no world is "
            "started anew",
        )
        yield (
            # they are counted in 32-bit integers
            self.total_updates < 2**31,
            f"total_steps {self.total_steps} are {self.total_updates} updates; fewer than 2^31 are "
            "possible",
        )

    def _demands_of_teams(self):
        """Networks for teams of several sizes have no input for a certain pursuer."""
        sizes = self.environment.team_sizes
        yield (
            not sizes or self.network.critic_encoder == "attention",
            f"network.critic_encoder {self.network.critic_encoder} is for teams of one size; "
            "attention would be right",
        )
        yield (
            not sizes
            or not self.predictor.enabled
            or self.environment.history_pursuers == "pooled",
            "predictor: frames of each pursuer are for teams of one size; "
            "environment.history_pursuers pooled would be right",
        )

    def _demands_of_evaders(self):
        """Evaders that learn decide evenly within a rollout, and one of them is no
        earlier self.
        """
        rollout = self.rollout_length
        hold = self.evader_learning.HOLD
        learned_number = self.environment.evaders.count("learned")
        yield (
            not learned_number or rollout % hold == 0,
            f"rollout_length {rollout} must be a multiple of {hold}, for which evaders that learn "
            "hold a decision",
        )
        past = self.evader_learning.past
        yield (
            not learned_number or past < learned_number,
            f"evader_learning.past {past} leaves none of {learned_number} learned "
            "evaders that learns; at "
            f"most {learned_number - 1} would be right",
        )

    def _demands_of_learners(self):
        """Minibatches, subsampled steps and the predictor's windows fit into a
        rollout.
        """
        rollout = self.rollout_length
        for name, number in self.minibatches.items():
            yield (
                self.num_envs % number == 0,
                f"num_envs {self.num_envs} must be a multiple of {name}.minibatches {number}",
            )
        yield (
            rollout % self.mappo.step_subsampling == 0,
            f"mappo.step_subsampling {self.mappo.step_subsampling} must divide rollout_length "
            f"{rollout}",
        )
        last = self.predictor.horizons[-1]
        windows = self.predictor.windows
        yield (
            not self.predictor.enabled or rollout - last + 1 >= windows,
            f"predictor: {windows} windows and horizon {last} do not fit into rollout_length "
            f"{rollout}",
        )

    @property
    def start_groups(self) -> int:
        """Groups of environments by start time; one of them ends its episodes after
        each rollout.
        """
        return self.environment.episode_length // self.rollout_length

    @property
    def episodes_per_task(self) -> int:
        """Environments that share one task; 1 without the generator."""
        return self.generator.episodes_per_task if self.generator.enabled else 1

    @property
    def world_unit(self) -> int:
        """Number of worlds that holds the same share of every start group, task and
        restart.
        """
        return self.start_groups * self.episodes_per_task * max(1, self.restart_every)

    @property
    def minibatches(self) -> dict[str, int]:
        """Minibatches of the learners that part the worlds, by the group of their
        settings.
        """
        minibatches = {"mappo": self.mappo.minibatches}
        if self.evaders_learn:
            minibatches["evader_learning"] = self.evader_learning.MINIBATCHES
        return minibatches

    @property
    def evaders_learn(self) -> bool:
        """True if evaders learn while pursuers do. Then scripted ones judge the validation, and
        a checkpoint ranks behind all later ones: who beats them early hasn't met what evaders
        learn late.
        """
        return "learned" in self.environment.evaders

    @property
    def validation_evaders(self) -> tuple[str, ...]:
        """Evaders of the validation; none: those of the training."""
        return self.VALIDATION_EVADERS if self.evaders_learn else ()

    @property
    def schedule(self) -> "Schedule":
        """The schedule by which worlds start."""
        from openjax.learning.schedule import Schedule

        # counted in rollouts; not at the age at which the episode ends anyhow
        every = self.restart_steps // self.rollout_length
        ages = tuple(range(every, self.start_groups, every))
        return Schedule(self.start_groups, self.episodes_per_task, self.restart_every, ages)

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one training step."""
        return self.num_envs * self.rollout_length

    @property
    def total_updates(self) -> int:
        """Training steps of the run."""
        return max(1, -(-self.total_steps // self.steps_per_update))  # rounded up
