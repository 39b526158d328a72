"""One training run from its settings to its report: compile, train, evaluate, draw."""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from openjax.background import in_background
from openjax.cluster.devices import (
    carry_shardings,
    check_devices,
    check_memory,
    make_device_phases,
    own_copy,
)
from openjax.cluster.processes import Processes
from openjax.commands.before_and_after import compare, game_for
from openjax.commands.evaluator import (
    before_after_table,
    evaluate_scenarios,
    layout_slots,
    record_of,
)
from openjax.commands.gradient_stages import compile_first_flights, compile_last_stage
from openjax.commands.run_words import closing_words, layouts_like
from openjax.commands.step_programs import step_programs
from openjax.commands.training_loop import NotFiniteError, Plan, StopRequest, run_updates
from openjax.commands.validation import SCORE_RULE, Validation, flat_metrics, selection_score
from openjax.learning import TrainSettings, build, make_start, summarise
from openjax.learning.train_state import policy_leaf
from openjax.policy import PolicyParameters
from openjax.policy.growth import with_longer_history
from openjax.pursuit import Pursuit
from openjax.show.metrics import METRICS_FILE, MetricsWriter, NoMetrics
from openjax.show.progress import Progress
from openjax.store.checkpoint_files import load_orbax
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import abstract_like, named_leaves, place
from openjax.store.policies import abstract_parameters, load_policy
from openjax.store.policy_files import fill, load_policy_file, save_policy_file
from openjax.store.run_directory import RunDirectory
from openjax.store.settings_files import write_json
from openjax.store.traced_programs import recalled

_SOON = 3.0
"""Seconds after which a training step that isn't ready doesn't come from the cache."""

_BESIDE_RECORD = ("episode_return", "last_seen_error")


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
    """Seconds of training after which to stop."""
    layout_episodes: int
    compare_with: str | None
    """Policy that the report shows beside the trained one."""
    facts: dict
    """Kept beside the settings: command line, machine."""
    started: float
    """`time.monotonic()` when the command started."""
    traced: Path | None = None
    """Folder in which traced programs are kept; None: they aren't."""

    @property
    def made_from(self) -> str:
        """What the run's programs depend on, beside the package's sources; the seed comes in as a key."""
        game = self.environment
        arrays = [
            np.asarray(leaf).tolist()
            for leaf in jax.tree.leaves((game.vehicle, game.effect_parameters, game.evader_network))
        ]
        names = jax.tree.structure(game.effect_parameters)
        return repr(
            (dataclasses.replace(self.settings, seed=0), game.settings, game.effects, str(names), arrays)
        )

    def check(self) -> None:
        """Raises UserError for what doesn't fit together, before any directory is touched."""
        check_devices(self.settings, self.devices)
        check_memory(self.settings, self.devices)
        if self.start_from is not None:
            _start_parameters(self, _abstract_parameters(self))
        if self.compare_with is not None:
            other = load_policy(self.compare_with)
            other.in_game(Pursuit(game_for(self.settings.environment, other)))


def run_job(job: TrainingJob, directory: RunDirectory, console: Console) -> int:
    """Train from the last checkpoint on, or from the start where there is none, then write the report.

    Returns:
      the exit status: 0, or 1 after a NaN.
    """
    settings, processes = job.settings, job.processes
    if not processes.is_first:
        console = Console(quiet=True)
    title = f"openjax.train → {directory.path}"
    with StopRequest() as stop, Progress(title, settings.total_steps, console) as progress:
        checkpoints = Checkpoints(directory.checkpoints, processes=processes, score_rule=SCORE_RULE)
        processes.advice = f"go on with openjax train --resume {directory.path} --devices all"
        progress.phase("compiling the start: networks, first tasks")
        start, step, abstract = _programs(job)
        step_ready = step.compile_ahead(abstract)  # takes longest, so it comes first
        first_flights = None
        if settings.first_flights.updates and not job.start_from and not checkpoints.any_finished():
            over = functools.partial(_over, job, stop)
            first_flights = compile_first_flights(
                settings, job.environment, abstract.policy, progress.message, over
            )
        carry, update, seconds = _first_carry(
            job, start, abstract, directory, checkpoints, progress, first_flights
        )
        if processes.is_first:
            directory.write_settings(settings, job.facts)

        def evaluate(carry):
            if not processes.is_first:
                return processes.of_first()
            uniform, far = (summarise(part) for part in validation()(own_copy(carry.policy))[:2])
            score = selection_score(uniform, settings.environment.episode_length)
            return processes.of_first((score, {**flat_metrics(uniform, far), "score": score}))

        metrics = NoMetrics()
        if processes.is_first:
            steps = update * settings.steps_per_update
            metrics = MetricsWriter(directory.path, update or None, resumed_steps=steps)
        try:
            progress.phase("compiling the training step")
            prepare_validation = functools.partial(_validation_ready, job, abstract)
            # while an accelerator's compiler works for long, validation is made beside it; else its tracing would
            # only hold up the first update, and on a CPU both would share the same cores
            beside = processes.is_first and jax.default_backend() != "cpu" and not step_ready(_SOON)
            if beside:
                validation = in_background(prepare_validation)
            step_ready()
            if processes.is_first and not beside:
                validation = in_background(prepare_validation)
            if processes.is_first and settings.analytic.updates:
                learn = in_background(lambda: compile_last_stage(settings, job.environment, abstract.policy))
            outcome = run_updates(
                step,
                carry,
                Plan(
                    total_updates=settings.total_updates,
                    steps_per_update=settings.steps_per_update,
                    validation_interval=settings.validation_interval,
                    time_limit=seconds + job.time_limit,
                    # an accelerator would wait for the validation's program
                    validate_start=first_flights is not None and jax.default_backend() == "cpu",
                ),
                checkpoints=checkpoints,
                metrics=metrics,
                progress=progress,
                directory=directory.path,
                stop=stop,
                evaluate=evaluate,
                first_update=update,
                seconds=seconds + time.monotonic() - job.started,
                everyone=processes.everyone,
            )
        except NotFiniteError as error:
            progress.message(f"stopped: {error}")
            return 1
        finally:
            metrics.close()
        signals = [name for name in processes.everyone(stop.name) if name is not None]
        if not processes.is_first:
            return 0
        _save_best(job, directory, checkpoints, outcome, progress.message)
        if outcome.update == update and settings.total_updates > update:
            what = "MAPPO did not begin" if first_flights else "nothing was trained"
            progress.message(
                f"{what}: {outcome.stopped_by} came before the first update, {outcome.seconds:.0f} s after the start"
            )
        if signals:
            progress.message(
                f"{signals[0]}: saved at update {outcome.update}; "
                f"go on with openjax train --resume {directory.path}"
            )
            return 0
        if settings.analytic.updates:
            progress.phase("learning by the gradient through the simulation")
            progress.message(_learn_analytic(job, directory, learn(), validation()))
        table = _report(job, directory, validation(), outcome, progress)
    console.print(table)
    for line in closing_words(settings, directory.path, jax.default_backend() == "cpu"):
        console.print(line, soft_wrap=True)
    console.print(f"run, policy and pictures are in {directory.path}, the chase in chase.gif", soft_wrap=True)
    return 0


def _programs(job):
    """The run's start and its step, from earlier runs' traces where they're kept, and the kind of the carry."""
    settings, shardings = job.settings, carry_shardings(job.devices)
    start = make_start(settings, job.environment)
    abstract = abstract_like(jax.eval_shape(start, jax.random.key(settings.seed)), shardings)
    phases = make_device_phases(settings, job.environment, job.devices)
    if job.traced is None or job.devices > 1:
        return start, step_programs(phases, job.devices, abstract), abstract
    keep = functools.partial(recalled, carry=abstract, made_from=job.made_from, folder=job.traced)

    def kept_start(key):
        return jax.jit(keep("start", start, lambda: (key,)), out_shardings=shardings)(key)

    return kept_start, step_programs(phases, job.devices, abstract, keep), abstract


def _over(job, stop):
    """Whether the run is to end: a signal to any process counts, and the first one's clock."""
    asked = job.processes.everyone([stop.name, time.monotonic() - job.started >= job.time_limit])
    return any(name is not None for name, _ in asked) or asked[0][1]


def _validation_ready(job, abstract):
    """The validation, compiled; and what else is needed soon after the first update is loaded."""
    load_orbax()
    validation = _validation(job)
    validation.evaluator.compile_ahead(abstract_like(abstract.policy), validation.tasks)()
    return validation


def _first_carry(job, start, abstract, directory, checkpoints, progress, first_flights):
    """The carry to start from, the updates done and the seconds spent; `abstract` is its kind."""
    settings = job.settings
    checkpoints.remove_unfinished()
    if job.processes.of_first(checkpoints.any_finished()):
        carry, record = checkpoints.restore_latest(abstract, progress.message)
        progress.message(f"resumed at update {record.update} of {settings.total_updates}")
        return carry, record.update, float(record.notes.get("seconds", 0.0))
    carry = start(jax.random.key(settings.seed))
    if job.start_from is not None:
        carry = carry.with_policy(_start_parameters(job, carry.policy))
    if job.processes.is_first:
        save_policy_file(directory.start_policy, carry.policy, settings, {"update": 0}, storage="float32")
    if first_flights is not None:
        progress.phase("learning to fly by the gradient through the simulation")
        key = jax.random.fold_in(jax.random.key(settings.seed), 1)
        carry = carry.with_policy(first_flights(carry.policy, key))
    return place(carry, carry_shardings(job.devices)), 0, 0.0


def _start_parameters(job, fresh: PolicyParameters) -> PolicyParameters:
    """Those of the policy that the run starts from; `fresh` ones where it has no critic, or one of another game."""
    loaded = load_policy(job.start_from)
    settings = loaded.settings
    own = with_longer_history(
        loaded.parameters, settings.predictor, settings.environment, job.settings.environment
    )
    kept = fresh.replace(critic={})
    kept = fill(kept, named_leaves(own.replace(critic={})), f"--start_from {job.start_from}")
    fits = jax.tree.map(jnp.shape, own.critic) == jax.tree.map(jnp.shape, fresh.critic)
    return kept.replace(critic=own.critic if fits else fresh.critic)


def _abstract_parameters(job) -> PolicyParameters:
    return abstract_parameters(job.environment, build(job.settings, job.environment).policy)


def _validation(job):
    """The validation tasks and their compiled evaluation, which has room for the layouts' pillars."""
    settings, environment = job.settings, job.environment
    evaders = settings.evaders_validation or settings.environment.evaders
    slots = layout_slots(settings.environment)
    wide = Pursuit(
        dataclasses.replace(settings.environment, max_pillars=slots, evaders=evaders),
        environment.vehicle,
        environment.effects,
        environment.effect_parameters,
        evader_network=environment.evader_network,
    )
    policy = build(settings, environment).policy
    return Validation(wide, settings.environment, policy, settings.validation_episodes)


def _save_best(job, directory, checkpoints, outcome, warn):
    """Write the policy of the best checkpoint, or of the latest where none was evaluated."""
    leaves, record = checkpoints.load_best(policy_leaf, warn)
    abstract = jax.eval_shape(lambda: outcome.carry.policy)
    parameters = fill(abstract, leaves, str(record.path))
    notes = {
        "update": record.update,
        "steps": record.update * job.settings.steps_per_update,
        "validation_score": record.score,
        "seconds": record.notes.get("seconds"),
        **job.facts,
    }
    save_policy_file(directory.policy, parameters, job.settings, notes, storage="float32")


def _learn_analytic(job, directory, learn, validation):
    """Take the run's policy through the last stage, and keep what it becomes if that validates better; a message."""
    began, settings = time.monotonic(), job.settings
    leaves, _, notes = load_policy_file(directory.policy)
    before = fill(_abstract_parameters(job), leaves, str(directory.policy))
    # where the validation, too, was compiled for
    before = place(before)
    after, history = learn(before, jax.random.key(settings.seed))
    summaries = [summarise(validation(parameters)[0]) for parameters in (before, after)]
    scores = [selection_score(summary, settings.environment.episode_length) for summary in summaries]
    kept = scores[1] > scores[0]
    facts = {"seconds": round(time.monotonic() - began, 1), "kept": kept, "validation_scores": scores}
    if kept:
        notes = {**notes, "validation_score": scores[1], "analytic_updates": len(history)}
        save_policy_file(directory.policy, after, settings, notes, storage="float32")
    write_json(directory.path / "analytic.json", {**facts, "validation": summaries, "history": history})
    return (
        f"by the gradient through the simulation: validation score {scores[0]:.4f} -> {scores[1]:.4f}"
        f"{'' if kept else ', not kept'}, {facts['seconds']:.0f} s"
    )


def _report(job, directory, validation, outcome, progress):
    """Evaluate the first and the best policy on the layouts and draw the best one's flights."""
    from openjax.show.plots import plot_training, plot_trajectories
    from openjax.show.videos import animate

    settings = job.settings
    fitting = layouts_like(settings.environment)
    abstract = jax.eval_shape(lambda: outcome.carry.policy)
    rows, flights = {}, []
    for moment, path in (("before", directory.start_policy), ("after", directory.policy)):
        progress.phase(f"evaluating the policy {moment} training on the layouts")
        parameters = fill(abstract, load_policy_file(path)[0], str(path))
        *evaluations, records = validation(parameters)
        rows[moment] = [
            record_of(name, validation.number, summarise(evaluation), _BESIDE_RECORD)
            for name, evaluation in zip(("validation", "validation_far"), evaluations, strict=True)
        ]
        flights = [_flight(validation, records, i) for i in range(min(3, validation.number))]
        if fitting:
            layouts, flights = evaluate_scenarios(
                validation.evaluator, parameters, fitting, job.layout_episodes, seed=0, extra=_BESIDE_RECORD
            )
            rows[moment] += layouts
    others, their_flights = [], []
    if job.compare_with is not None:
        progress.phase(f"evaluating {job.compare_with} in the same game")
        # its networks may be large, and these are minutes on a small machine
        others, their_flights = compare(
            load_policy(job.compare_with),
            job.environment,
            fitting,
            min(job.layout_episodes, 8),
            min(validation.number, 32),
        )
    progress.phase("drawing")
    write_json(
        directory.path / "layouts.json",
        {
            **rows,
            **({job.compare_with: others} if others else {}),
            "updates": outcome.update,
            "steps": outcome.update * settings.steps_per_update,
            "seconds": round(outcome.seconds, 1),
            **job.facts,
        },
    )
    plot_training(directory.path / "training.png", directory.path / METRICS_FILE)
    plot_trajectories(directory.path / "trajectories.png", flights)
    captured = [flight for flight in flights if flight.capture_index is not None]
    chosen = (captured or flights)[0]
    shown = [flight for flight in their_flights if flight.title.startswith(f"{chosen.title}, ")]
    shown.insert(0, dataclasses.replace(chosen, title=f"{chosen.title}, this run") if shown else chosen)
    drawn_by = animate(directory.path / "chase.gif", *shown)
    progress.phase(f"done (animation by {drawn_by})")
    return before_after_table(rows["before"], rows["after"], job.compare_with, others)


def _flight(validation, records, episode):
    task = jax.tree.map(lambda leaf: np.asarray(leaf[episode]), validation.tasks)
    return validation.evaluator.trajectory(records, episode, task, f"validation task {episode + 1}")
