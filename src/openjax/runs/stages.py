"""The stages of a training run, in their order: begin, first flights, MAPPO, the best
checkpoint, the last stage. Each takes the run and what the one before it gave.
"""

import contextlib
import dataclasses
import time

import jax

from openjax.cluster.devices import carry_shardings, everywhere, own_copy
from openjax.evaluation.episodes import summarise
from openjax.evaluation.validation import flat_metrics, selection_score
from openjax.interruption import StopRequest
from openjax.learning import TrainCarry
from openjax.learning.train_state import policy_leaf
from openjax.runs.job import TrainingJob
from openjax.runs.last_stage import BestPolicy, keep_best
from openjax.runs.loop import Loop, Outcome, Plan, Stopped
from openjax.runs.programs import Programs
from openjax.runs.words import first_flights_words, how_to_go_on
from openjax.show.metrics import Continuation, MetricsWriter
from openjax.show.progress import Progress
from openjax.store.checkpoints import CheckpointRecord, Checkpoints
from openjax.store.leaves import place
from openjax.store.policy_files import fill, save_policy_file
from openjax.store.run_directory import RunDirectory

EARLY = 10.0
"""Taken from the score of a checkpoint before `validation_start`: no policy's score is as low."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One process' part of a run: what all of its stages share."""

    job: TrainingJob
    directory: RunDirectory
    checkpoints: Checkpoints
    programs: Programs
    progress: Progress
    stop: StopRequest

    def is_over(self, deadline: float) -> bool:
        """True if the run is to end: a signal to any process counts, and the first one's
        clock (`time.monotonic`).
        """
        answers = self.job.processes.everyone([self.stop.name, time.monotonic() >= deadline])
        return any(name is not None for name, _ in answers) or answers[0][1]


@dataclasses.dataclass(frozen=True)
class RunState:
    """The progress of a run before its updates go on."""

    carry: TrainCarry
    update: int
    """Updates that were done ..."""
    seconds: float
    """... by earlier processes, in so long a time."""
    is_restored: bool
    """True if the carry comes from a checkpoint."""
    is_due: bool
    """True if the carry is to be validated before anything else."""
    deadline: float = float("inf")
    """The end of the time for learning (`time.monotonic`)."""


def begin(run: Run) -> RunState:
    """The newest checkpoint, or a fresh carry; the settings, or the policy to begin with, are
    written.
    """
    job = run.job
    settings = job.settings
    checkpoints = run.checkpoints
    checkpoints.remove_unfinished()
    if job.processes.of_first(checkpoints.any_finished()):
        carry, record = checkpoints.restore_latest(run.programs.carry, run.progress.message)
        run.progress.message(f"resumed at update {record.update} of {settings.total_updates}")
        is_due = awaits_validation(record, job)
        if job.processes.is_first:
            run.directory.write_settings(settings, job.facts)
        return RunState(carry, record.update, float(record.notes.get("seconds", 0.0)), True, is_due)
    carry = run.programs.start(jax.random.key(settings.seed))
    if job.start is not None:
        critic = job.start.critic or carry.policy.critic
        carry = carry.replace(policy=job.start.replace(critic=critic))
    if job.processes.is_first:
        notes = {"update": 0}
        path = run.directory.start_policy
        save_policy_file(path, carry.policy, settings, notes, storage="float32")
    return RunState(place(carry, carry_shardings(job.devices)), 0, 0.0, False, False)


def awaits_validation(record: CheckpointRecord, job: TrainingJob) -> bool:
    """True if a run was stopped between a checkpoint and its validation: of the start, after
    first flights, or of an update at which one is made. It comes when the run goes on, so
    that it ends as one that nobody stopped.
    """
    settings = job.settings
    if record.update == 0:
        is_validated = settings.first_flights.updates > 0 and job.command.start_from is None
    else:
        is_last = record.update == settings.total_updates
        is_validated = is_last or record.update % settings.validation_interval == 0
    return is_validated and record.score is None


def fly_first(run: Run, state: RunState) -> RunState:
    """The policy after the stage before MAPPO, of a run that has it still to come."""
    program = run.programs.first_flights
    if program is None:
        return state
    job = run.job
    run.progress.phase("compiling the first flights")
    program.wait()
    deadline = time.monotonic() + job.time_limit
    run.progress.phase("learning to fly by the gradient through the simulation")
    key = jax.random.fold_in(jax.random.key(job.settings.seed), 1)
    policy = state.carry.policy
    learnt = program.learn(policy, key, run.progress.message, lambda: run.is_over(deadline))
    if learnt is None:
        return dataclasses.replace(state, deadline=deadline)
    policy = policy.replace(actor=place(learnt.actor, everywhere(job.devices)))
    carry = state.carry.replace(policy=policy)
    return dataclasses.replace(state, carry=carry, is_due=True, deadline=deadline)


def learn(run: Run, state: RunState) -> Outcome:
    """All updates, until a signal or the time limit.

    Raises:
      Stopped: one of them came before anything was learnt, or a NaN.
    """
    over = run.is_over(state.deadline)
    if over and not state.is_restored and not state.is_due:
        reason = run.stop.name or "the time limit"
        words = how_to_go_on(run.checkpoints, run.directory)
        raise Stopped(f"{reason} came: {words}; ending as soon as the compiler does")
    with contextlib.ExitStack() as stack:
        metrics = None
        if run.job.processes.is_first:
            metrics = stack.enter_context(contextlib.closing(_metrics(run, state)))
        goes_on = not over and state.update < run.job.settings.total_updates
        run.progress.phase("compiling the training step", announce=goes_on)
        if goes_on:
            run.programs.step_ready()
        loop = Loop(
            run.programs.step,
            _plan(run, state),
            checkpoints=run.checkpoints,
            metrics=metrics,
            progress=run.progress,
            directory=run.directory.path,
            stop=run.stop,
            evaluate=CheckpointScore(run),
            first_update=state.update,
            seconds=state.seconds + time.monotonic() - run.job.began,
            everyone=run.job.processes.everyone,
        )
        stack.enter_context(run.stop.while_learning())
        return loop.run(state.carry)


def _plan(run, state):
    """The steps that are left to do."""
    settings = run.job.settings
    return Plan(
        total_updates=settings.total_updates,
        steps_per_update=settings.steps_per_update,
        validation_interval=settings.validation_interval,
        time_limit=min(state.deadline - time.monotonic(), run.job.time_limit),
        validate_start=state.is_due,
    )


def _metrics(run, state):
    """The writer of metrics: a fresh one, or one that continues from a checkpoint."""
    continuation = None
    if state.is_restored:
        steps = state.update * run.job.settings.steps_per_update
        continuation = Continuation(state.update, steps, state.is_due)
    return MetricsWriter(run.directory.path, continuation, on_record=run.job.own_parts.on_record)


@dataclasses.dataclass(frozen=True)
class CheckpointScore:
    """Score and metrics of a carry on the validation tasks; the same in all processes."""

    run: Run

    def __call__(self, carry: TrainCarry) -> tuple[float, dict[str, float]]:
        """Waits for the compiler where it must: a signal then ends the command at once."""
        processes = self.run.job.processes
        if not processes.is_first:
            return processes.of_first()
        with self.run.stop.while_compiling():
            validation = self.run.programs.validation()
        # a copy: on several devices the carry's leaves lie elsewhere than the validation's
        uniform, far_tasks = (
            summarise(kind.evaluation) for kind in validation(own_copy(carry.policy))
        )
        settings = self.run.job.settings
        score = selection_score(uniform, settings.environment.episode_length)
        if int(carry.update) == 0:
            self.run.progress.message(first_flights_words(uniform))
        if settings.evaders_learn and int(carry.update) < settings.total_updates:
            score -= EARLY
        return processes.of_first((score, {**flat_metrics(uniform, far_tasks), "score": score}))

    def is_ready(self) -> bool:
        """True if nobody would have to wait for the compiler."""
        run = self.run
        return run.job.processes.of_first(
            run.programs.validation is not None and run.programs.validation.is_ready
        )


def choose(run: Run, outcome: Outcome, first_update: int) -> BestPolicy:
    """Write the policy of the best checkpoint, or of the latest where none was evaluated.

    Raises:
      Stopped: a signal ended the run, or another process writes the rest.
    """
    job = run.job
    settings = job.settings
    signals = [name for name in job.processes.everyone(run.stop.name) if name is not None]
    if not job.processes.is_first:
        raise Stopped("process 0 writes the report")
    leaves, record = run.checkpoints.load_best(policy_leaf, run.progress.message)
    notes = {
        "update": record.update,
        "steps": record.update * settings.steps_per_update,
        "validation_score": record.score,
        "seconds": record.notes.get("seconds"),
        **job.facts,
    }
    parameters = fill(run.programs.carry.policy, leaves, str(record.path))
    best = BestPolicy(run.directory.policy, parameters, settings, notes)
    best.save()
    if outcome.update == first_update and settings.total_updates > outcome.update:
        moment = f"before its first update, {outcome.seconds:.0f} s after the start"
        run.progress.message(f"MAPPO did not begin: {outcome.stopped_by} came {moment}")
    if signals:
        raise Stopped(f"{signals[0]}: {how_to_go_on(run.checkpoints, run.directory)}")
    return best


def improve(run: Run, best: BestPolicy) -> None:
    """Take the policy through the last stage, where the run has one.

    Raises:
      Stopped: a signal came.
    """
    if run.job.settings.analytic.updates:
        run.progress.phase("learning by the gradient through the simulation")
        validation = run.programs.validation

        def validate(parameters):
            # the far tasks: by the uniform ones the best of many checkpoints was
            # chosen, in part by luck
            return summarise(validation()(parameters)[1].evaluation)

        stage = run.programs.last_stage()
        validation()
        with run.stop.while_learning():
            line = keep_best(best, stage, validate, lambda: run.stop.name is not None)
        run.progress.message(line)
    if run.stop.name is not None:
        raise Stopped(f"{run.stop.name}: {how_to_go_on(run.checkpoints, run.directory)}")
