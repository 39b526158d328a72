"""The start of a run: its directory made or opened, its job put together, everything before the
first array.
"""

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import jax

from openjax.cluster.processes import Processes
from openjax.command_line import output_console
from openjax.errors import UserError
from openjax.files import remove_unfinished, to_plain
from openjax.learning import build
from openjax.runs.game_files import GameFiles
from openjax.runs.job import OwnParts, TrainingJob, check_job, start_parameters
from openjax.runs.machine import describe_machine
from openjax.runs.other_policy import other_policy
from openjax.runs.request import complete, default_preset
from openjax.runs.train_command import PROGRAM, TrainCommand
from openjax.runs.training import run_job
from openjax.runs.words import opening_words
from openjax.store.checkpoints import Checkpoints
from openjax.store.compiled_programs import cache_programs
from openjax.store.run_directory import RunDirectory, check_free, create_run, lock_run, open_run


def start(
    command: TrainCommand,
    arguments: Sequence[str],
    start_time: float,
    processes: Processes,
    own_parts: OwnParts | None = None,
) -> int:
    """Make the run's directory, or open it, and train. Returns the exit status.

    Args:
      command: what to do.
      arguments: the command line, for the run's facts.
      start_time: `time.monotonic()` when the command started.
      processes: that train together.
      own_parts: what was handed in from Python; None: nothing, the command was typed.
    """
    cache = cache_programs() if command.compilation_cache else None
    job, directory, files = prepare(command, arguments, start_time, processes, own_parts)
    # a caller may have changed functions since they were loaded
    if cache is not None and own_parts is None:
        job = dataclasses.replace(job, traced=cache / "traced")
    # a mistake shows before any process changes a file
    _check_same(job.settings, processes)
    # one process writes for all, and no second run into its directory
    with lock_run(directory.path) if processes.is_first else contextlib.nullcontext():
        if command.resume is None and processes.is_first:
            create_run(directory.path, command.overwrite)
            files.copy_to(directory.path)
            directory.write_settings(job.settings, job.facts)
            output_console().print(opening_words(job.settings), soft_wrap=True)
        elif processes.is_first:
            remove_unfinished(directory.path)
            if line := other_compiler(directory.read_facts()):
                output_console().print(line, soft_wrap=True)
        # nobody looks for the directory before the first process has made it
        processes.everyone()
        if not directory.path.is_dir():
            raise UserError(
                f"{directory.path} isn't there on the host of process {processes.index}; all hosts "
                "must share it"
            )
        return run_job(job, directory, console=output_console())


def prepare(
    command: TrainCommand,
    arguments: Sequence[str],
    start_time: float,
    processes: Processes,
    own_parts: OwnParts | None = None,
) -> tuple[TrainingJob, RunDirectory, GameFiles]:
    """The training, its directory, and the files that its game is made of; nothing is changed yet.
    Arguments as of `start`.

    Raises:
      UserError: whatever can be wrong with the files or the settings.
    """
    if jax.config.jax_enable_x64:
        raise UserError("jax_enable_x64 is on; openjax trains in 32 bits: turn it off")
    own_parts = own_parts or OwnParts()
    old_run = None if command.resume is None else open_run(command.resume)
    stored_facts = {} if old_run is None else old_run.read_facts()
    files = GameFiles.of(command, old_run)
    _check_parts(own_parts, files, stored_facts)
    environment = own_parts.environment or files.environment(command.settings.environment)
    command = complete(command, environment, stored_facts)
    directory = old_run or RunDirectory(_free_directory(command, processes))
    parts = build(command.settings, environment, own_parts.policy, own_parts.learners)
    # needed again only where a run was killed before its first checkpoint
    starts_from = None if _has_begun(old_run) else command.start_from
    job = TrainingJob(
        command=command,
        parts=parts,
        own_parts=own_parts,
        devices=int(command.devices),
        processes=processes,
        start=starts_from and start_parameters(starts_from, command.settings, parts),
        other=command.compare_with and other_policy(command.compare_with, environment),
        facts=_facts(command, arguments, own_parts),
        began=start_time,
    )
    check_job(job)
    return (job, directory, files)


def _facts(command, arguments, own_parts):
    """Facts that are kept beside the settings, so that a resumed run goes on with them."""
    return {
        **({"own_parts": own_parts.names} if own_parts.names else {}),
        "command": " ".join([PROGRAM, *arguments]),
        "machine": describe_machine(),
        "devices": int(command.devices),
        "start_from": command.start_from,
        "compare_with": command.compare_with,
        "layout_episodes": command.layout_episodes,
    }


def _has_begun(run):
    return run is not None and Checkpoints(run.checkpoints).any_finished()


def other_compiler(facts: dict) -> str | None:
    """A remark for a run whose last process, by its facts, had another JAX than this one; None if
    it had the same, or the facts don't say.
    """
    machine = facts.get("machine")
    versions = machine.get("versions") if isinstance(machine, dict) else None
    version = versions.get("jax") if isinstance(versions, dict) else None
    if version in (None, jax.__version__):
        return None
    return (
        f"this run was trained with JAX {version} so far; JAX {jax.__version__} rounds "
        "differently: from here on it isn't bit for bit the same run"
    )


def _check_parts(parts, files, facts):
    """Raises UserError for parts of one's own that don't go with files, or with the run
    that is resumed, whose facts these are.
    """
    if parts.environment is not None and files.are_named:
        raise UserError("an environment of your own already has its vehicle, effects and evader")
    # a new run may have any; one that is resumed and says nothing had none
    first = facts.get("own_parts", []) if facts else parts.names
    if first != parts.names:
        raise UserError(
            f"the run was begun with {', '.join(first) or 'no part'} of your own, and now has "
            f"{', '.join(parts.names) or 'none'}; pass openjax.train(resume=...) the same ones"
        )


def _free_directory(command, processes):
    """The directory of a new run, the same for all processes. Raises UserError if it can't be
    written.
    """
    name = f"{time.strftime('%Y%m%d-%H%M%S')}-{command.preset or default_preset()}"
    out = Path(processes.of_first(str(command.out or Path("runs") / name)))
    check_free(out, command.overwrite)
    return out


def _check_same(settings, processes):
    """Raises UserError where processes were started with different settings: their
    results would drift apart.
    """
    facts = {"settings": to_plain(settings), "JAX": jax.__version__}
    for other, others_facts in enumerate(processes.everyone(facts)):
        different = [name for name in facts if facts[name] != others_facts[name]]
        if different:
            raise UserError(
                f"processes {other} and {processes.index} differ in their {' and '.join(different)}"
            )
