"""One training run from its job to its report."""

import contextlib
import functools

import jax
from rich.console import Console

from openjax import interruption
from openjax.interruption import StopRequest
from openjax.runs.job import TrainingJob
from openjax.runs.loop import Stopped
from openjax.runs.programs import make_programs
from openjax.runs.report import report
from openjax.runs.stages import Run, begin, choose, fly_first, improve, learn
from openjax.runs.words import closing_words, how_to_go_on
from openjax.show.progress import Progress
from openjax.store.checkpoints import Checkpoints
from openjax.store.run_directory import RunDirectory


def run_job(job: TrainingJob, directory: RunDirectory, console: Console) -> int:
    """Train from the last checkpoint on, or from the start where there is none, then
    write the report.

    Returns:
      the exit status: 0, or 1 after a NaN.
    """
    settings = job.settings
    if not job.processes.is_first:
        console = Console(quiet=True)
    job.processes.advice = f"go on with openjax train --resume {directory.path} --devices all"
    checkpoints = Checkpoints(directory.checkpoints, processes=job.processes)
    words = functools.partial(how_to_go_on, checkpoints, directory)
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(StopRequest())
        progress = Progress(f"openjax.train → {directory.path}", settings.total_steps, console)
        stack.enter_context(progress)
        stack.enter_context(interruption.clean_up(checkpoints.abandon))
        stack.enter_context(interruption.last_words(words))
        has_begun = checkpoints.any_finished()
        is_done = checkpoints.reach(settings.total_updates)
        if is_done:
            progress.message(
                "all updates are done, and the report is made again; --total_steps N adds more"
            )
        progress.phase("compiling the start: networks, first tasks", announce=not has_begun)
        try:
            programs = make_programs(job, has_begun, is_done)
            run = Run(job, directory, checkpoints, programs, progress, stop)
            state = begin(run)
            state = fly_first(run, state)
            outcome = learn(run, state)
            improve(run, choose(run, outcome, state.update))
            table = report(job, directory, programs.validation(), outcome, progress)
        except Stopped as reason:
            progress.message(str(reason))
            return reason.status
    console.print(table)
    on_cpu = jax.default_backend() == "cpu"
    for line in closing_words(settings, directory.path, on_cpu, job.own_parts.policy is not None):
        console.print(line, soft_wrap=True)
    words = f"run, policy and pictures are in {directory.path}, the chase in chase.gif"
    console.print(words, soft_wrap=True)
    return 0
