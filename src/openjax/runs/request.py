"""The request to `openjax train`: its command line read, checked, and completed by what the
machine or a resumed run settles.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax

from openjax.cluster.devices import can_share_out
from openjax.cluster.joining import Membership, find_membership
from openjax.command_line import parse, peek
from openjax.errors import UserError
from openjax.learning import TrainSettings, preset
from openjax.pursuit import Pursuit
from openjax.ranges import check_intervals
from openjax.runs.train_command import MAY_CHANGE, PROGRAM, TrainCommand
from openjax.runs.words import different_settings
from openjax.store.policies import known_policies
from openjax.store.run_directory import EVADER_FILE, open_run, read_config


def read_command(arguments: Sequence[str]) -> TrainCommand:
    """The command line as `TrainCommand`, its settings complete.

    Raises:
      UserError: anything wrong with it, before a file is touched.
    """
    resume = peek(arguments, "resume")
    name = peek(arguments, "preset")
    config = peek(arguments, "config")
    if resume is not None:
        for option, value in (("preset", name), ("config", config)):
            if value is not None:
                raise UserError(
                    f"--{option} and --resume exclude each other: a resumed run keeps its settings"
                )
        default = open_run(Path(resume)).read_settings()
    else:
        default = preset(name or default_preset())
        if config is not None:
            default = read_config(Path(config), default)
    command = parse(TrainCommand, TrainCommand(settings=default), arguments, PROGRAM)
    if resume is not None:
        check_resumed(command, default)
    if command.steps is not None:
        settings = dataclasses.replace(command.settings, total_steps=command.steps)
        command = dataclasses.replace(command, settings=settings)
    return command


def membership(arguments: Sequence[str]) -> Membership | None:
    """The place among several processes that the command line or the job's manager gives to this
    one.

    It's needed before the command line can be read in full, as a preset depends on the devices.
    """
    if {"-h", "--help"} & set(arguments):
        return None

    # not by tyro, which isn't asked before the devices are known; nine digits hold any job's number
    def number(name):
        text = peek(arguments, name)
        if text is not None and not (text.isdecimal() and len(text) <= 9):
            raise UserError(f"--{name} is {text[:40]!r}; expected a number")
        return None if text is None else int(text)

    return find_membership(
        peek(arguments, "coordinator_address"),
        number("num_processes"),
        number("process_id"),
        all_devices=peek(arguments, "devices") == "all",
    )


def default_preset() -> str:
    """`quick` without an accelerator, else `paper`."""
    return "quick" if jax.default_backend() == "cpu" else "paper"


def check_resumed(command: TrainCommand, stored_settings: TrainSettings) -> None:
    """Raises UserError for options that don't go with --resume, and settings that a run
    can't take up in its middle.
    """
    resume = command.resume
    if command.out is not None and command.out.resolve() != resume.resolve():
        raise UserError(f"--resume {resume} writes there; don't give --out")
    if command.overwrite:
        raise UserError("--resume and --overwrite exclude each other")
    options = ["start_from", "effects", "vehicle", "opponent"]
    evader = open_run(resume).optional(EVADER_FILE)
    if "own" in stored_settings.environment.evaders and evader is None:
        options.remove("opponent")  # a function isn't in the run's files
    changes = [name for name in options if getattr(command, name) is not None]
    for name in (*changes, *different_settings(command.settings, stored_settings)):
        if name not in MAY_CHANGE:
            raise UserError(
                f"--{name} can't change when a run is resumed; {', '.join(MAY_CHANGE)} can, or "
                "start another run with --start_from"
            )


def complete(command: TrainCommand, environment: Pursuit, stored_facts: dict) -> TrainCommand:
    """The command with what is settled by its game, by the machine, or by the run that is
    resumed, whose facts these are.
    """
    settings = dataclasses.replace(command.settings, environment=environment.settings)
    episodes = command.layout_episodes or stored_facts.get("layout_episodes")
    whole = dataclasses.replace(
        command,
        settings=settings,
        devices=str(_devices(command.devices, settings, stored_facts.get("devices"))),
        start_from=_lasting(command.start_from) or stored_facts.get("start_from"),
        layout_episodes=episodes or _layout_episodes(environment),
        compare_with=_comparison(command, stored_facts),
    )
    check_intervals(whole, "--")
    return whole


def _devices(text, settings, saved_settings):
    """The number of devices; by default as many as the run had (`saved_settings`, None for a new
    one), or as many cores as the worlds divide among.
    """
    available = len(jax.devices())
    if text is None and jax.default_backend() == "cpu" and jax.process_count() == 1:
        numbers = range(1, available + 1)
        if saved_settings in numbers:
            return saved_settings
        return max(number for number in numbers if can_share_out(settings, number))
    text = text or "1"
    if text == "all":
        return available
    if not (text.isdecimal() and len(text) <= 9 and 1 <= int(text) <= available):
        raise UserError(f"--devices is {text[:40]!r}; expected all, or a number up to {available}")
    return int(text)


def _layout_episodes(environment):
    """The default number of episodes of each layout."""
    settings = environment.settings
    differ = settings.start_attitude == "drawn" or settings.vehicles or environment.effects
    if not differ:  # one episode says all
        return 1
    return 32 if jax.default_backend() == "cpu" else 100


def _comparison(command, facts):
    """The policy to compare with; None for none."""
    if command.compare_with is not None:
        return None if command.compare_with == "none" else _lasting(command.compare_with)
    if command.resume is not None:
        return facts.get("compare_with")
    # beside a run of minutes, a policy of hours shows what more time is worth
    fits = command.settings.environment.num_pursuers == TrainSettings().environment.num_pursuers
    return "open" if fits and (command.preset or default_preset()) == "quick" else None


def _lasting(start_from):
    """The name of a policy, or a path that also holds in other folders."""
    # what isn't there is left as it was typed, and the error that follows names it so
    if start_from is None or start_from in known_policies() or not Path(start_from).exists():
        return start_from
    return str(Path(start_from).absolute())
