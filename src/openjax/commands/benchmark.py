"""Speed on this machine: `openjax benchmark [--envs 1024 4096] [--json FILE]`.

Steps per second of the physics (rigid and MJX, each with and without solids), of the environment,
of rollouts with the policy and of the whole training step, over a sweep of environment counts; and
of the programs that the step is made of, which say where its time goes; the step on several
devices, with `--devices 1 2 4`. Same command on CPU and GPU.
"""

import dataclasses
import importlib
from collections.abc import Sequence

from openjax.command_line import output_console, parse, peek
from openjax.commands.options import PARTS, BenchmarkCommand
from openjax.errors import UserError
from openjax.files import check_output, write_json
from openjax.learning.presets import preset
from openjax.show.progress import Steps

PROGRAM = "openjax benchmark"
PHYSICS = ("rigid_free", "rigid", "mjx_free", "mjx")
SECONDS = dict(zip(PARTS, (4.0, 5.0, 13.0, 25.0, 10.0, 15.0, 110.0), strict=True))
"""That each part takes to compile on two cores, about."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    if peek(arguments, "devices") is not None:
        from openjax.platform import make_cores_devices

        make_cores_devices()
    command = parse(BenchmarkCommand, _default(arguments), arguments, PROGRAM)
    check_output(command.json, "--json")
    import jax

    # said before minutes of compiling
    if max(command.devices) > (available := len(jax.devices())):
        raise UserError(f"--devices is {max(command.devices)}; this machine has {available}")
    from openjax.commands.benchmark_cases import cases, time_compiled
    from openjax.runs.machine import describe_machine

    machine = describe_machine()
    console = output_console()
    print(
        f"{machine['device']}, JAX {machine['versions']['jax']}, commit {machine['commit']}",
        flush=True,
    )
    rows = []
    facts = {"command": " ".join([PROGRAM, *arguments]), "machine": machine}
    facts["compilation_cache"] = jax.config.jax_compilation_cache_dir is not None
    sweep = _sweep(command)
    with Steps("measuring", {name: seconds for name, *_, seconds in sweep}, console) as steps:
        for name, part, number, _ in sweep:
            steps.begin(name)
            for case in cases(command, part, number):
                timing = time_compiled(case, command.seconds)
                rows.append(_row(case, command.settings, timing))
                console.print(_line(rows[-1]), soft_wrap=True)
                # after each measurement, so that an interrupted sweep leaves what it has
                write_json(command.json, {**facts, "settings": command.settings, "rows": rows})
    if sentence := _programs_and_step(rows):
        print(sentence)
    print(f"written to {command.json}")
    return 0


def _default(arguments) -> BenchmarkCommand:
    """The default of what is measured: what fits the machine."""
    # help needn't wait for JAX
    on_cpu = bool({"-h", "--help"} & set(arguments))
    if not on_cpu:
        on_cpu = importlib.import_module("jax").default_backend() == "cpu"
    return BenchmarkCommand(
        envs=(64, 512) if on_cpu else (2048, 8192, 32768, 131072, 1048576),
        training_envs=(320,) if on_cpu else (2048, 4096, 8192, 16384),
        settings=preset(peek(arguments, "preset") or ("quick" if on_cpu else "paper")),
    )


def _sweep(command) -> list[tuple[str, str, int, float]]:
    """(name, part, environments, seconds that it takes on two cores, about) of all that
    is measured.
    """
    sweep = []
    for part in command.parts:
        numbers = command.envs
        programs = 1
        if part == "training":
            numbers = command.training_envs
            programs = 5 * len(command.devices)
        seconds = SECONDS[part] + programs * command.seconds
        sweep += [(f"{part}, {number:,} environments", part, number, seconds) for number in numbers]
    return sweep


def _programs_and_step(rows) -> str | None:
    """The seconds that the step's programs take beside the step as one; None where one of them
    wasn't measured.
    """
    phases = [row["seconds"] for row in rows if row["part"].startswith("- ")]
    if not phases or None in phases:
        return None
    seconds = sum(row["seconds"] for row in rows if row["part"] == "training")
    return (
        f"the parts of the training step take {1e3 * sum(phases):,.1f} ms one by one, the "
        f"whole step {1e3 * seconds:,.1f} ms"
    )


def _row(case, settings, timing) -> dict:
    """One measurement (a `Timing`); an environment step moves one world by one control
    step, all its drones.
    """
    drones = settings.environment.num_pursuers
    physics = settings.environment.physics
    if case.name in PHYSICS:
        physics = case.name.split("_")[0]
    # without seconds it ran out of memory
    speed = None if timing.seconds is None else case.num_envs * case.steps / timing.seconds
    return {
        "part": case.name,
        "physics": physics,
        "num_envs": case.num_envs,
        "num_drones": drones,
        "steps_per_call": case.steps,
        "env_steps_per_second": speed,
        "drone_steps_per_second": None if speed is None else speed * drones,
        **dataclasses.asdict(timing),
    }


def _line(row):
    speed = row["env_steps_per_second"]
    memory = row["memory"]
    words = (
        "out of memory"
        if speed is None
        else f"{speed:,.0f} env steps/s, {1e3 * row['seconds']:,.1f} ms"
    )
    needs = "" if memory is None else f", {memory / 1e6:,.0f} MB"
    note = f"compiled in {row['compile_seconds']:.1f} s{needs}"
    return f"{row['part']:17} {row['num_envs']:>9,} environments: {words} ({note})"
