"""One training run from its settings to its report: compile, train, evaluate, draw."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from openjax import interruption
from openjax.background import compile_ahead, in_background
from openjax.baselines import Heuristic
from openjax.cluster.devices import (
    carry_shardings,
    check_devices,
    check_memory,
    compiler_options,
    everywhere,
    make_device_step,
    own_copy,
)
from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.evaluation.episodes import summarise
from openjax.evaluation.validation import Validation, flat_metrics, selection_score
from openjax.files import write_json
from openjax.interruption import StopRequest
from openjax.learning import Learner, Parts, TrainSettings, build, make_start
from openjax.learning.train_state import policy_leaf
from openjax.policy import Network, Policy, PolicyParameters
from openjax.policy.growth import with_longer_history
from openjax.pursuit import Pursuit
from openjax.runs.gradient_stages import (
    compile_first_flights,
    compile_last_stage,
    first_flights,
)
from openjax.runs.loop import Loop, NotFiniteError, Outcome, Plan, guarded
from openjax.runs.report import game_for, report
from openjax.runs.words import closing_words
from openjax.show.metrics import MetricsWriter
from openjax.show.progress import Progress
from openjax.store.checkpoint_files import load_orbax
from openjax.store.checkpoints import CheckpointRecord, Checkpoints
from openjax.store.leaves import abstract_like, named_leaves, place
from openjax.store.policies import abstract_parameters, load_policy
from openjax.store.policy_files import fill, load_policy_file, save_policy_file
from openjax.store.run_directory import RunDirectory
from openjax.store.traced_programs import recalled

EARLY = 10.0
"""Taken from the score of a checkpoint before `validation_start`: no policy's score is as low."""
_SOON = 3.0
"""Seconds after which a training step that isn't ready doesn't come from the cache."""


@dataclasses.dataclass(frozen=True)
class OwnParts:
    """Parts of a run that were handed in from Python; see `openjax.learning.build`."""

    environment: Pursuit | None = None
    policy: Policy | Network | None = None
    learners: Mapping[str, Learner] | None = None

    @property
    def names(self) -> list[str]:
        """What they are: a run that was begun with them goes on with the same ones only."""
        given = [field.name for field in dataclasses.fields(self) if getattr(self, field.name)]
        return given + [f"learner {name}" for name in self.learners or ()]


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
        """What the run's programs depend on, beside the package's sources; the seed comes in as a
        key.
        """
        game = self.environment
        settings = dataclasses.replace(self.settings, seed=0)
        arrays = jax.tree.leaves((game.vehicle, game.effect_parameters))
        arrays = [np.asarray(leaf).tolist() for leaf in arrays]
        names = str(jax.tree.structure(game.effect_parameters))
        return repr((self.devices, settings, game.settings, game.effects, names, arrays))

    @property
    def keep(self) -> Callable | None:
        """`recalled` for the run's programs; None where traces aren't kept, or where functions of
        one's own are in them, whose text nobody knows.
        """
        game = self.environment
        if self.traced is None or self.own.names or game.evaders or game.reward or game.observer:
            return None
        return functools.partial(recalled, made_from=self.made_from, folder=self.traced)

    def check(self) -> None:
        """Raises UserError for what doesn't fit together, before any directory is touched."""
        check_devices(self.settings, self.devices)
        check_memory(self.settings, self.devices)
        if self.start_from is not None:
            abstract = abstract_parameters(self.environment, self.parts.policy)
            _start_parameters(self, abstract)
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


def run_job(job: TrainingJob, directory: RunDirectory, console: Console) -> int:
    """Train from the last checkpoint on, or from the start where there is none, then write the
    report.

    Returns:
      the exit status: 0, or 1 after a NaN.
    """
    if not job.processes.is_first:
        console = Console(quiet=True)
    title = f"openjax.train → {directory.path}"
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        progress = stack.enter_context(Progress(title, job.settings.total_steps, console))
        run = _Run(job, directory, stop, progress)
        stack.enter_context(interruption.cleaning(run.checkpoints.abandon))
        stack.enter_context(interruption.telling(run.last_words))
        try:
            outcome = run.train()
        except NotFiniteError as error:
            progress.message(f"stopped: {error}")
            return 1
        table = None if outcome is None else run.finish(outcome)
    if table is not None:
        console.print(table)
        for line in closing_words(job.settings, directory.path, jax.default_backend() == "cpu"):
            console.print(line, soft_wrap=True)
        console.print(
            f"run, policy and pictures are in {directory.path}, the chase in chase.gif",
            soft_wrap=True,
        )
    return 0


class _Run:
    """One process' part of a run: what its steps share, and the programs as they get ready."""

    def __init__(
        self, job: TrainingJob, directory: RunDirectory, stop: StopRequest, progress: Progress
    ):
        self.job = job
        self.directory = directory
        self.stop = stop
        self.progress = progress
        self.settings = job.settings
        self.processes = job.processes
        self.taught, self.began, self.validation = False, float("inf"), None
        self.checkpoints = Checkpoints(directory.checkpoints, processes=job.processes)
        self.processes.advice = f"go on with openjax train --resume {directory.path} --devices all"

    def train(self) -> Outcome | None:
        """Compile and train; None where a signal or the time limit came before anything was learnt.
        Raises NotFiniteError.
        """
        job = self.job
        settings = self.settings
        latest = self.checkpoints.latest()
        done = self.processes.of_first(
            latest is not None and latest.update >= settings.total_updates
        )
        if done:
            self.progress.message(
                "all updates are done; --total_steps N goes on to more. Its report is made anew"
            )
        self.progress.phase("compiling the start: networks, first tasks", announce=latest is None)
        start, step, self.abstract = _programs(job)
        # takes longest, so it comes first
        step_ready = (lambda *_: None) if done else compile_ahead(step, self.abstract)
        self.first_flights = self._first_flights()
        carry, self.first_update, seconds = self._first_carry(start)
        if self.processes.is_first:
            self.directory.write_settings(settings, job.facts)
        over = self._over()
        if over and not self.first_update and not self.taught:
            limit = f"the time limit came: {self.last_words()}"
            self.progress.message(f"{limit}; ending as soon as the compiler does")
            return None
        with self._metrics() as metrics:
            self.progress.phase("compiling the training step", announce=not (done or over))
            self._compile_beside((lambda *_: None) if over else step_ready)
            self.began = min(self.began, time.monotonic())
            loop = Loop(
                step,
                self._plan(seconds),
                checkpoints=self.checkpoints,
                metrics=metrics,
                progress=self.progress,
                directory=self.directory.path,
                stop=self.stop,
                evaluate=self._evaluate,
                first_update=self.first_update,
                seconds=seconds + time.monotonic() - job.started,
                everyone=self.processes.everyone,
            )
            with self.stop.while_learning():
                return loop.run(carry)

    def last_words(self) -> str:
        """What there is of the run, and how it goes on, should it end now."""
        update = self.checkpoints.last_finished()
        saved = "nothing was learnt yet" if update is None else f"saved at update {update}"
        return f"{saved}; go on with openjax train --resume {self.directory.path}"

    def _plan(self, seconds):
        """What the loop is to do after so many seconds of earlier processes."""
        settings = self.settings
        return Plan(
            total_updates=settings.total_updates,
            steps_per_update=settings.steps_per_update,
            validation_interval=settings.validation_interval,
            time_limit=seconds + self.began - self.job.started + self.job.time_limit,
            validate_start=self.taught,
        )

    def finish(self, outcome: Outcome) -> Table | None:
        """Write the best policy, then the report, whose table it is; None where a signal ended the
        run.
        """
        settings = self.settings
        signals = [name for name in self.processes.everyone(self.stop.name) if name is not None]
        if not self.processes.is_first:
            return None
        self._save_best()
        if outcome.update == self.first_update and settings.total_updates > outcome.update:
            when = f"before its first update, {outcome.seconds:.0f} s after the start"
            self.progress.message(f"MAPPO did not begin: {outcome.stopped_by} came {when}")
        if not signals and settings.analytic.updates:
            self.progress.phase("learning by the gradient through the simulation")
            self.progress.message(self._learn_last())
        if asked := (*signals, self.stop.name)[0]:
            self.progress.message(f"{asked}: {self.last_words()}")
            return None
        return report(self.job, self.directory, self.validation(), outcome, self.progress)

    def _learn_last(self):
        """The last stage; what to tell of it."""

        def validate(parameters):
            # the far tasks: by the uniform ones the best of many checkpoints was chosen, in part by
            # luck
            return summarise(self._await_validation()(parameters)[1].evaluation)

        learn = self.last_stage()
        with self.stop.while_learning():
            return keep_best(
                self.directory, learn, validate, self.job, lambda: self.stop.name is not None
            )

    def _await_validation(self):
        """The validation, as soon as it is compiled."""
        with self.stop.while_compiling():
            return self.validation()

    def _first_flights(self):
        """The stage before MAPPO, of a run that has it still to come; else None."""
        if (
            not self.settings.first_flights.updates
            or self.job.start_from
            or self.checkpoints.any_finished()
        ):
            return None
        flights = first_flights(self.settings, self.job.environment)
        say = self.progress.message
        policy = self.abstract.policy
        return compile_first_flights(flights, policy, say, self._over, self.job.keep)

    def _over(self):
        """Whether the run is to end: a signal to any process counts, and the first one's clock."""
        late = time.monotonic() - self.began >= self.job.time_limit
        asked = self.processes.everyone([self.stop.name, late])
        return any(name is not None for name, _ in asked) or asked[0][1]

    def _first_carry(self, start):
        """The carry to start from, the updates done and the seconds spent."""
        job = self.job
        settings = self.settings
        checkpoints = self.checkpoints
        checkpoints.remove_unfinished()
        if self.processes.of_first(checkpoints.any_finished()):
            carry, record = checkpoints.restore_latest(self.abstract, self.progress.message)
            self.taught = awaits_validation(record, settings, job.facts["start_from"])
            self.progress.message(f"resumed at update {record.update} of {settings.total_updates}")
            return carry, record.update, float(record.notes.get("seconds", 0.0))
        carry = start(jax.random.key(settings.seed))
        if job.start_from is not None:
            carry = carry.replace(policy=_start_parameters(job, carry.policy))
        if self.processes.is_first:
            save_policy_file(
                self.directory.start_policy,
                carry.policy,
                settings,
                {"update": 0},
                storage="float32",
            )
        if self.first_flights is not None:
            ready, learn = self.first_flights
            self.progress.phase("compiling the first flights")
            if jax.default_backend() != "cpu":  # whose cores have enough to do
                self._prepare_validation()
            ready()
            self.began = time.monotonic()
            self.progress.phase("learning to fly by the gradient through the simulation")
            policy = learn(carry.policy, jax.random.fold_in(jax.random.key(settings.seed), 1))
            self.taught = policy is not None
            carry = carry.replace(policy=policy) if self.taught else carry
        return place(carry, carry_shardings(job.devices)), 0, 0.0

    def _metrics(self):
        """Where this process writes metrics, as a context manager."""
        if not self.processes.is_first:
            return contextlib.nullcontext()
        steps = self.first_update * self.settings.steps_per_update
        writer = MetricsWriter(self.directory.path, self.first_update or None, resumed_steps=steps)
        return contextlib.closing(writer)

    def _compile_beside(self, step_ready):
        """Wait for the training step; what is needed later is compiled in the background."""
        first = self.processes.is_first
        settings = self.settings
        # while an accelerator's compiler works for long, validation is made beside it; else its
        # tracing would only hold up the first update, and on a CPU both would share the same cores
        if jax.default_backend() != "cpu":
            try:
                step_ready(_SOON)
            except TimeoutError:
                self._prepare_validation()
        step_ready()
        self._prepare_validation()
        if first and settings.analytic.updates:
            kinds = settings, self.job.environment, self.abstract.policy
            self.last_stage = in_background(functools.partial(compile_last_stage, *kinds))

    def _prepare_validation(self):
        """Start to make the validation, once, where it is to be."""
        if self.processes.is_first and self.validation is None:
            self.validation = in_background(self._ready_validation)

    def _ready_validation(self):
        """The validation, compiled; and what else is needed soon after the first update is
        loaded.
        """
        load_orbax()
        settings, environment = self.settings, self.job.environment
        validation = Validation(
            environment,
            self.job.parts.policy,
            settings.validation_episodes,
            settings.evaders_validation,
        )
        tasks = validation.tasks["validation"]
        validation.evaluator.compile_ahead(abstract_like(self.abstract.policy), tasks)()
        return validation

    def _evaluate(self, carry):
        """Score and metrics of a carry on the validation tasks; the same in all processes."""
        if not self.processes.is_first:
            return self.processes.of_first()
        uniform, far = (
            summarise(kind.evaluation) for kind in self._await_validation()(own_copy(carry.policy))
        )
        settings = self.settings
        score = selection_score(uniform, settings.environment.episode_length)
        if int(carry.update) < settings.validation_start * settings.total_updates:
            score -= EARLY
        return self.processes.of_first((score, {**flat_metrics(uniform, far), "score": score}))

    def _save_best(self):
        """Write the policy of the best checkpoint, or of the latest where none was evaluated."""
        leaves, record = self.checkpoints.load_best(policy_leaf, self.progress.message)
        notes = {
            "update": record.update,
            "steps": record.update * self.settings.steps_per_update,
            "validation_score": record.score,
            "seconds": record.notes.get("seconds"),
            **self.job.facts,
        }
        parameters = fill(self.abstract.policy, leaves, str(record.path))
        save_policy_file(self.directory.policy, parameters, self.settings, notes, storage="float32")


def awaits_validation(
    record: CheckpointRecord, settings: TrainSettings, started_from: str | None
) -> bool:
    """Whether a run was stopped after its first flights and before its start was validated: that
    comes when it is resumed, as what a run starts from may be the best there will be.

    Args:
      record: of the checkpoint that it goes on from.
      settings: of the run.
      started_from: the policy that it began with, which had no first flights.
    """
    unscored = record.update == 0 and record.score is None
    return unscored and settings.first_flights.updates > 0 and started_from is None


def _programs(job):
    """The run's start and its step, from earlier runs' traces where they're kept, and the kind of
    the carry.
    """
    settings = job.settings
    shardings = carry_shardings(job.devices)
    start = make_start(settings, job.parts)
    abstract = abstract_like(jax.eval_shape(start, jax.random.key(settings.seed)), shardings)
    same = everywhere(job.devices)
    step = guarded(make_device_step(settings, job.parts, job.devices))
    tried = job.devices == 1 or (jax.default_backend() == "cpu" and jax.process_count() == 1)
    if tried and (keep := job.keep):
        step = keep("step", step, lambda: (abstract,), carry=abstract)
        fresh = start

        def start(key):
            program = keep("start", fresh, lambda: (key,), carry=abstract)
            return jax.jit(program, out_shardings=shardings)(key)

    # without shardings, the compiler may move a leaf, and the next call would compile again; all
    # processes can read the rest
    options = {
        "out_shardings": (shardings, same, same),
        "compiler_options": compiler_options(job.devices),
    }
    return start, jax.jit(step, donate_argnums=0, **options), abstract


def _start_parameters(job, fresh: PolicyParameters) -> PolicyParameters:
    """Those of the policy that the run starts from; `fresh` ones where it has no critic, or one of
    another game.
    """
    loaded = load_policy(job.start_from)
    if isinstance(loaded.policy, Heuristic):
        raise UserError(f"--start_from {job.start_from}: a heuristic has no networks to start from")
    settings = loaded.settings
    axes = job.settings.environment.observe_in
    there = settings.environment.observe_in
    if axes != there:  # of the same shapes
        raise UserError(
            f"--start_from {job.start_from}: it observes in {there}, the run in {axes} "
            "(--environment.observe_in)"
        )
    own = with_longer_history(
        loaded.parameters, settings.predictor, settings.environment, job.settings.environment
    )
    kept = fresh.replace(critic={})
    kept = fill(kept, named_leaves(own.replace(critic={})), f"--start_from {job.start_from}")
    fits = jax.tree.map(jnp.shape, own.critic) == jax.tree.map(jnp.shape, fresh.critic)
    return kept.replace(critic=own.critic if fits else fresh.critic)


def keep_best(
    directory: RunDirectory,
    learn: Callable[[PolicyParameters, jax.Array], Iterator[tuple[PolicyParameters, dict]]],
    validate: Callable[[PolicyParameters], dict],
    job: TrainingJob,
    over: Callable[[], bool],
) -> str:
    """Take a run's policy through the last stage, and keep the best of what it becomes and what it
    was.

    Args:
      directory: the run's; `policy.npz` is what the stage starts from, and what it writes.
      learn: (parameters, key) -> after each update the parameters and its metrics.
      validate: parameters -> summary of validation tasks by which no checkpoint was chosen.
      job: the run's; its settings and parts are looked at.
      over: is asked after each update whether to stop.

    Returns:
      what to tell of it.
    """
    began = time.monotonic()
    settings = job.settings
    before, _, notes = load_policy_file(directory.policy)
    abstract = abstract_parameters(job.parts.environment, job.parts.policy)
    # where the validation, too, was compiled for
    before = place(fill(abstract, before, str(directory.policy)))
    length = settings.environment.episode_length
    looks = [{"update": 0, **validate(before)}]
    history = []
    kept = 0
    scores = [selection_score(looks[0], length)]
    for after, parts in learn(before, jax.random.key(settings.seed)):
        history.append(parts)
        if over():
            break
        if (
            len(history) % settings.analytic.look_every
            and len(history) != settings.analytic.updates
        ):
            continue
        looks.append({"update": len(history), **validate(after)})
        scores.append(selection_score(looks[-1], length))
        if scores[-1] > scores[kept]:
            kept = len(looks) - 1
            better = {"far_validation_score": scores[kept], "analytic_updates": len(history)}
            # at once: a stage that is ended early leaves the best of what it was
            save_policy_file(
                directory.policy, after, settings, {**notes, **better}, storage="float32"
            )
    seconds = round(time.monotonic() - began, 1)
    updates = looks[kept]["update"]
    facts = {"seconds": seconds, "kept": updates, "validation_scores": scores}
    write_json(directory.path / "analytic.json", {**facts, "validation": looks, "history": history})
    told = f"{scores[0]:.4f} -> {scores[kept]:.4f} after {updates} of {len(history)} updates"
    if not kept:
        told = (
            f"{scores[0]:.4f}, at most {max(scores[1:], default=scores[0]):.4f} after it, not kept"
        )
    return f"by the gradient through the simulation: score on far validation tasks {told}, {seconds:.0f} s"
