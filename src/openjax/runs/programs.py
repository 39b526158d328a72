"""The programs of a training run. Once `Programs` are made they are complete, and all of
them are being compiled, in the order in which they are needed.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from openjax.background import Pending, compile_ahead, one_by_one
from openjax.cluster.devices import (
    carry_shardings,
    compiler_options,
    everywhere,
    make_device_step,
)
from openjax.evaluation.validation import ValidationTasks
from openjax.learning import TrainCarry, make_start
from openjax.learning.training_step import Phases
from openjax.runs.gradient_stages import (
    FirstFlightsProgram,
    compile_first_flights,
    compile_last_stage,
)
from openjax.runs.job import TrainingJob
from openjax.runs.loop import guarded
from openjax.store.checkpoint_files import load_orbax
from openjax.store.leaves import abstract_like
from openjax.store.traced_programs import recall

_SOON = 3.0
"""Seconds after which a training step that isn't ready doesn't come from the cache."""


@dataclasses.dataclass(frozen=True)
class TrainingStep:
    """The training step as two programs, which are compiled beside each other: what draws
    new tasks runs for a hundredth of the time, and is a quarter of the compiler's work.
    """

    fly_and_learn: Callable[[TrainCarry], tuple]
    begin_episodes: Callable[[TrainCarry], tuple]
    """See `guarded`. Both take the carry's buffers."""

    def __call__(self, carry: TrainCarry) -> tuple:
        """As of a step that is `guarded`."""
        carry, metrics = self.fly_and_learn(carry)
        carry, counts, has_nan = self.begin_episodes(carry)
        return carry, metrics | counts, has_nan

    def compile_ahead(self, carry: TrainCarry) -> Callable[..., None]:
        """Start to compile for a carry of these shapes and places; what waits for it."""
        pending = [
            compile_ahead(program, carry) for program in (self.fly_and_learn, self.begin_episodes)
        ]

        def wait(seconds=None):
            for program in pending:
                program(seconds)

        return wait


@dataclasses.dataclass(frozen=True)
class Programs:
    """The programs that a run compiles."""

    carry: TrainCarry
    """Shapes, dtypes and places of the carry's leaves."""
    start: Callable[[jax.Array], TrainCarry]
    """Key -> the carry of a fresh run."""
    step: TrainingStep
    step_ready: Callable[[], Any]
    """Waits until the step is compiled."""
    first_flights: FirstFlightsProgram | None
    """None where they aren't part of the run, or are over."""
    validation: Pending | None
    """Gives a `ValidationTasks`; None in all processes but the first."""
    last_stage: Pending | None
    """Gives the stage, see `compile_last_stage`; None where `validation` is."""


def make_programs(job: TrainingJob, has_begun: bool, is_done: bool) -> Programs:
    """Those that a run still needs which has a checkpoint, or has done all its updates."""
    settings = job.settings
    start, step, carry = _start_and_step(job)
    # takes longest, so it comes first
    step_ready = _nothing_to_wait_for if is_done else step.compile_ahead(carry)
    first_flights = None
    if settings.first_flights.updates and not has_begun and job.start is None:
        first_flights = compile_first_flights(job, carry.policy, kept_programs(job))
    background = [
        functools.partial(_give_way, step_ready),
        functools.partial(_make_validation, job, carry.policy),
        functools.partial(compile_last_stage, job, carry.policy),
    ]
    # the first process alone validates and writes
    _, validation, last_stage = one_by_one(background) if job.processes.is_first else (None,) * 3
    return Programs(carry, start, step, step_ready, first_flights, validation, last_stage)


def _nothing_to_wait_for():
    """In the place of a program that isn't needed any more."""


def _give_way(step_ready):
    """Let what is needed first be compiled: on a CPU all programs share the cores. An
    accelerator's compiler works for long, and the others may as well be made beside it; but
    where a kept program is only loaded, tracing others would hold up the first update.
    """
    with contextlib.suppress(Exception):  # whoever waits for the step is told
        if jax.default_backend() == "cpu":
            step_ready()
        else:
            step_ready(_SOON)


def _make_validation(job, policy):
    """The validation, compiled for parameters of these shapes; and what else is needed soon
    after the first update is loaded.
    """
    load_orbax()
    settings = job.settings
    validation = ValidationTasks(
        job.parts.environment,
        job.parts.policy,
        settings.validation_episodes,
        settings.validation_evaders,
    )
    tasks = validation.tasks["validation"]
    validation.evaluator.compile_ahead(abstract_like(policy), tasks)()
    return validation


def _start_and_step(job):
    """The run's start and its step, from earlier runs' traces where they're kept, and
    the kind of the carry.
    """
    settings = job.settings
    shardings = carry_shardings(job.devices)
    start = make_start(settings, job.parts)
    carry = abstract_like(jax.eval_shape(start, jax.random.key(settings.seed)), shardings)
    # where kept traces have been tried
    can_keep = job.devices == 1 or (jax.default_backend() == "cpu" and jax.process_count() == 1)
    keep = kept_programs(job) if can_keep else None
    same = everywhere(job.devices)

    def program(name, function, others):
        if keep:
            function = keep(name, function, lambda: (carry,), carry=carry)
        # without shardings, the compiler may move a leaf, and the next call would compile
        # again; all processes can read the rest
        return jax.jit(
            function,
            donate_argnums=0,
            out_shardings=(shardings, *others * (same,)),
            compiler_options=compiler_options(job.devices),
        )

    learn, begin = (
        make_device_step(settings, job.parts, job.devices, part)
        for part in (Phases.fly_and_learn, Phases.begin_episodes)
    )
    step = TrainingStep(
        program("fly_and_learn", learn, 1), program("begin_episodes", guarded(begin), 2)
    )
    return _kept_start(start, carry, shardings, keep) if keep else start, step, carry


def _kept_start(start, carry, shardings, keep):
    """The start, from earlier runs' traces where they're kept."""

    def start_by_trace(key):
        program = keep("start", start, lambda: (key,), carry=carry)
        return jax.jit(program, out_shardings=shardings)(key)

    return start_by_trace


def kept_programs(job: TrainingJob) -> Callable | None:
    """`recall` for the run's programs; None where traces aren't kept, or where functions of
    one's own are in them, whose text nobody knows.
    """
    game = job.parts.environment
    if job.traced is None or job.own_parts.names or game.evaders or game.reward or game.observer:
        return None
    return functools.partial(recall, made_from=_made_from(job), folder=job.traced)


def _made_from(job):
    """Everything that the run's programs depend on beside the package's sources; the seed comes in
    as a key.
    """
    game = job.parts.environment
    settings = dataclasses.replace(job.settings, seed=0)
    # numbers that are written into the programs as constants
    leaves = jax.tree.leaves((game.vehicle, game.effect_parameters))
    arrays = [np.asarray(leaf).tolist() for leaf in leaves]
    names = str(jax.tree.structure(game.effect_parameters))
    return repr((job.devices, settings, game.settings, game.effects, names, arrays))
