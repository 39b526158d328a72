"""One training run from its job to its report: compile, train, evaluate, draw."""

import contextlib
import functools
import time

import jax
from rich.console import Console
from rich.table import Table

from openjax import interruption
from openjax.background import compile_ahead, in_background
from openjax.cluster.devices import (
    carry_shardings,
    compiler_options,
    everywhere,
    make_device_step,
    own_copy,
)
from openjax.command_line import as_typed
from openjax.evaluation.episodes import summarise
from openjax.evaluation.validation import Validation, flat_metrics, selection_score
from openjax.interruption import StopRequest
from openjax.learning import TrainSettings, make_start
from openjax.learning.train_state import policy_leaf
from openjax.runs.gradient_stages import compile_first_flights, compile_last_stage, first_flights
from openjax.runs.job import TrainingJob, start_parameters
from openjax.runs.last_stage import keep_best
from openjax.runs.loop import Loop, NotFiniteError, Outcome, Plan, guarded
from openjax.runs.report import report
from openjax.runs.words import closing_words
from openjax.show.metrics import MetricsWriter
from openjax.show.progress import Progress
from openjax.store.checkpoint_files import load_orbax
from openjax.store.checkpoints import CheckpointRecord, Checkpoints
from openjax.store.leaves import abstract_like, place
from openjax.store.policy_files import fill, save_policy_file
from openjax.store.run_directory import RunDirectory

EARLY = 10.0
"""Taken from the score of a checkpoint before `validation_start`: no policy's score is
as low.
"""
_SOON = 3.0
"""Seconds after which a training step that isn't ready doesn't come from the cache."""


def run_job(job: TrainingJob, directory: RunDirectory, console: Console) -> int:
    """Train from the last checkpoint on, or from the start where there is none, then
    write the report.

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
        stack.enter_context(interruption.clean_up(run.checkpoints.abandon))
        stack.enter_context(interruption.last_words(run.last_words))
        try:
            outcome = run.train()
        except NotFiniteError as error:
            progress.message(f"stopped: {error}")
            return 1
        table = None if outcome is None else run.finish(outcome)
    if table is not None:
        console.print(table)
        for line in closing_words(
            job.settings, directory.path, jax.default_backend() == "cpu", job.own.policy is not None
        ):
            console.print(line, soft_wrap=True)
        console.print(
            f"run, policy and pictures are in {directory.path}, the chase in chase.gif",
            soft_wrap=True,
        )
    return 0


class _Run:
    """One process' part of a run: what its steps share, and the programs as they get
    ready.
    """

    def __init__(
        self, job: TrainingJob, directory: RunDirectory, stop: StopRequest, progress: Progress
    ):
        self.job = job
        self.directory = directory
        self.stop = stop
        self.progress = progress
        self.settings = job.settings
        self.processes = job.processes
        self.checkpoints = Checkpoints(directory.checkpoints, processes=job.processes)
        self.abstract = None
        """Shapes of the carry."""
        self.first_update = 0
        """Updates that were done before this process began."""
        self.taught = False
        """Whether first flights have taught the policy something that isn't validated
        yet.
        """
        self.began = float("inf")
        """When learning began (`time.monotonic`), from which on a time limit counts."""
        # programs that are made in the background, each a function that waits for the
        # compiler
        self.first_flights = None
        self.validation = None
        self.last_stage = None
        self.processes.advice = f"go on with openjax train --resume {directory.path} --devices all"

    def train(self) -> Outcome | None:
        """Compile and train; None where a signal or the time limit came before anything
        was learnt. Raises NotFiniteError.
        """
        job = self.job
        settings = self.settings
        latest = self.checkpoints.latest()
        is_done = latest is not None and latest.update >= settings.total_updates
        first_done = self.processes.of_first(is_done)
        if first_done:
            self.progress.message(
                "all updates are done; --total_steps N goes on to more. Its report is made anew"
            )
        self.progress.phase("compiling the start: networks, first tasks", announce=latest is None)
        start, step, self.abstract = _programs(job)
        # takes longest, so it comes first
        step_ready = _nothing_to_wait_for if first_done else compile_ahead(step, self.abstract)
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
            self.progress.phase("compiling the training step", announce=not (first_done or over))
            self._compile_beside(_nothing_to_wait_for if over else step_ready)
            self.began = min(self.began, time.monotonic())
            loop = self._loop(step, metrics, seconds)
            with self.stop.while_learning():
                return loop.run(carry)

    def _loop(self, step, metrics, seconds):
        """The host's side of training, after so many seconds of earlier processes."""
        return Loop(
            step,
            self._plan(seconds),
            checkpoints=self.checkpoints,
            metrics=metrics,
            progress=self.progress,
            directory=self.directory.path,
            stop=self.stop,
            evaluate=self._evaluate,
            first_update=self.first_update,
            seconds=seconds + time.monotonic() - self.job.started,
            everyone=self.processes.everyone,
        )

    def last_words(self) -> str:
        """What there is of the run, and how it goes on, should it end now."""
        update = self.checkpoints.last_finished()
        checkpoint_words = (
            "nothing was learnt yet" if update is None else f"saved at update {update}"
        )
        return (
            f"{checkpoint_words}; go on with "
            f"{as_typed(f'openjax train --resume {self.directory.path}')}"
        )

    def _plan(self, seconds):
        """What the loop is to do after so many seconds of earlier processes."""
        settings = self.settings
        return Plan(
            total_updates=settings.total_updates,
            steps_per_update=settings.steps_per_update,
            validation_interval=settings.validation_interval,
            # the loop's clock begins with the command, the limit's when learning does
            time_limit=seconds + self.began - self.job.started + self.job.time_limit,
            validate_start=self.taught,
        )

    def finish(self, outcome: Outcome) -> Table | None:
        """Write the best policy, then the report, whose table it is; None where a
        signal ended the run.
        """
        settings = self.settings
        signals = [name for name in self.processes.everyone(self.stop.name) if name is not None]
        if not self.processes.is_first:
            return None
        # before the last stage: should that be cut off, there is a policy
        self._save_best()
        if outcome.update == self.first_update and settings.total_updates > outcome.update:
            moment = f"before its first update, {outcome.seconds:.0f} s after the start"
            self.progress.message(f"MAPPO did not begin: {outcome.stopped_by} came {moment}")
        if not signals and settings.analytic.updates:
            self.progress.phase("learning by the gradient through the simulation")
            self.progress.message(self._learn_last())
        if stop_name := (*signals, self.stop.name)[0]:
            self.progress.message(f"{stop_name}: {self.last_words()}")
            return None
        return report(self.job, self.directory, self.validation(), outcome, self.progress)

    def _learn_last(self):
        """The last stage; what to tell of it."""

        def validate(parameters):
            # the far tasks: by the uniform ones the best of many checkpoints was
            # chosen, in part by luck
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
        is_part = self.settings.first_flights.updates and not self.job.start_from
        if not is_part or self.checkpoints.any_finished():
            return None
        flights = first_flights(self.settings, self.job.environment)
        say = self.progress.message
        policy = self.abstract.policy
        return compile_first_flights(flights, policy, say, self._over, self.job.keep)

    def _over(self):
        """Whether the run is to end: a signal to any process counts, and the first
        one's clock.
        """
        out_of_time = time.monotonic() - self.began >= self.job.time_limit
        answers = self.processes.everyone([self.stop.name, out_of_time])
        return any(name is not None for name, _ in answers) or answers[0][1]

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
            carry = carry.replace(policy=start_parameters(job, carry.policy))
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
            if self.taught:
                carry = carry.replace(policy=policy)
        return place(carry, carry_shardings(job.devices)), 0, 0.0

    def _metrics(self):
        """Where this process writes metrics, as a context manager."""
        if not self.processes.is_first:
            return contextlib.nullcontext()
        steps = self.first_update * self.settings.steps_per_update
        writer = MetricsWriter(self.directory.path, self.first_update or None, resumed_steps=steps)
        return contextlib.closing(writer)

    def _compile_beside(self, step_ready):
        """Wait for the training step; what is needed later is compiled in the
        background.
        """
        first = self.processes.is_first
        settings = self.settings
        # while an accelerator's compiler works for long, validation is made beside it;
        # else its tracing would only hold up the first update, and on a CPU both would
        # share the same cores
        if jax.default_backend() != "cpu":
            try:
                step_ready(_SOON)
            except TimeoutError:
                self._prepare_validation()
        step_ready()
        self._prepare_validation()
        if first and settings.analytic.updates:
            compile_it = functools.partial(
                compile_last_stage, settings, self.job.environment, self.abstract.policy
            )
            self.last_stage = in_background(compile_it)

    def _prepare_validation(self):
        """Start to make the validation, once, where it is to be."""
        if self.processes.is_first and self.validation is None:
            self.validation = in_background(self._ready_validation)

    def _ready_validation(self):
        """The validation, compiled; and what else is needed soon after the first update
        is loaded.
        """
        load_orbax()
        settings = self.settings
        validation = Validation(
            self.job.environment,
            self.job.parts.policy,
            settings.validation_episodes,
            settings.evaders_validation,
        )
        tasks = validation.tasks["validation"]
        validation.evaluator.compile_ahead(abstract_like(self.abstract.policy), tasks)()
        return validation

    def _evaluate(self, carry):
        """Score and metrics of a carry on the validation tasks; the same in all
        processes.
        """
        if not self.processes.is_first:
            return self.processes.of_first()
        # a copy: on several devices the carry's leaves lie elsewhere than the
        # validation's
        validation = self._await_validation()
        uniform, far_tasks = (
            summarise(kind.evaluation) for kind in validation(own_copy(carry.policy))
        )
        settings = self.settings
        score = selection_score(uniform, settings.environment.episode_length)
        if int(carry.update) < settings.validation_start * settings.total_updates:
            score -= EARLY
        return self.processes.of_first(
            (score, {**flat_metrics(uniform, far_tasks), "score": score})
        )

    def _save_best(self):
        """Write the policy of the best checkpoint, or of the latest where none was
        evaluated.
        """
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


def _nothing_to_wait_for(*_):
    """In the place of a program that isn't needed any more."""


def awaits_validation(
    record: CheckpointRecord, settings: TrainSettings, started_from: str | None
) -> bool:
    """Whether a run was stopped after its first flights and before its start was
    validated: that comes when it is resumed, as what a run starts from may be the best
    there will be.

    Args:
      record: of the checkpoint that it goes on from.
      settings: of the run.
      started_from: the policy that it began with, which had no first flights.
    """
    has_no_score = record.update == 0 and record.score is None
    return has_no_score and settings.first_flights.updates > 0 and started_from is None


def _programs(job):
    """The run's start and its step, from earlier runs' traces where they're kept, and
    the kind of the carry.
    """
    settings = job.settings
    shardings = carry_shardings(job.devices)
    start = make_start(settings, job.parts)
    abstract = abstract_like(jax.eval_shape(start, jax.random.key(settings.seed)), shardings)
    same = everywhere(job.devices)
    step = guarded(make_device_step(settings, job.parts, job.devices))
    # where kept traces have been tried
    can_keep = job.devices == 1 or (jax.default_backend() == "cpu" and jax.process_count() == 1)
    if can_keep and (keep := job.keep):
        step = keep("step", step, lambda: (abstract,), carry=abstract)
        fresh = start

        def start(key):
            program = keep("start", fresh, lambda: (key,), carry=abstract)
            return jax.jit(program, out_shardings=shardings)(key)

    # without shardings, the compiler may move a leaf, and the next call would compile
    # again; all processes can read the rest
    options = {
        "out_shardings": (shardings, same, same),
        "compiler_options": compiler_options(job.devices),
    }
    return start, jax.jit(step, donate_argnums=0, **options), abstract
