"""openjax beside crazyflow and JaxMARL on this machine: `python -m experiments.compare [--seconds 125] [--out DIR]`.

Drone steps per second of the simulations, environment steps per second of the games, and of whole training steps.
Compilation is timed apart; each call is waited for; the median of all calls counts. Writes compare.json after each
measurement and compare.md at the end. What the time didn't suffice for, or what failed, stands there as such.
"""

import dataclasses
import sys
import time
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Literal

import jax

from experiments.compare import drones, games, report
from experiments.compare.case import Case
from experiments.compare.stand_ins import use_stand_ins
from openjax.commands.command_line import parse, run_command
from openjax.commands.machine import describe_machine
from openjax.commands.timing import time_compiled
from openjax.errors import UserError
from openjax.files import read_json
from openjax.store.settings_files import write_json

PROGRAM = "python -m experiments.compare"
RESULTS = Path(__file__).parents[1] / "results"
LIBRARIES = ("crazyflow", "jaxmarl", "scipy", "gymnasium", "casadi", "gymnax")
# Imported by crazyflow or JaxMARL for symbolic models, drawing, other environments and saving: not by what is timed.
NOT_TIMED = ("casadi", "gymnax", "imageio", "matplotlib", "mpl_toolkits", "PIL", "safetensors")


@dataclasses.dataclass(frozen=True)
class CompareCommand:
    """Time openjax, crazyflow and JaxMARL in one run."""

    worlds: tuple[int, ...] = (32768, 131072, 1048576)
    """Worlds of drones; the variants beside run at the middle one."""
    drones: tuple[int, ...] = (1, 3)
    """Drones per world."""
    environments: tuple[int, ...] = (4096, 32768)
    """Worlds of the games."""
    training: tuple[int, ...] = (5120,)
    """Worlds of the training steps (JaxMARL's also with its own number)."""
    preset: str = "paper"
    """Preset of our training step."""
    steps: int = 50
    """Steps per call of drones and games."""
    min_seconds: float = 0.4
    """Shortest time to measure each."""
    seconds: float = 125.0
    """Time after which nothing new is begun."""
    out: Path = RESULTS
    """Directory of compare.json and compare.md."""
    peers: Path | None = None
    """An earlier compare.json whose rows of the other libraries stand in for those that aren't installed."""
    only: tuple[Literal["drones", "training", "environment"], ...] = ("drones", "training", "environment")
    """What to measure."""
    commit: str | None = None
    """Commit to name in the results where git can't tell."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    begun = time.monotonic()
    command = parse(CompareCommand, CompareCommand(), arguments, PROGRAM)
    sizes = command.worlds + command.drones + command.environments + command.training
    if not command.worlds or min(sizes) < 1 or command.steps < 1 or command.min_seconds <= 0:
        raise UserError("--worlds, --drones, --environments, --training and --steps must be positive")
    stand_ins = use_stand_ins(NOT_TIMED)
    machine = describe_machine()
    if command.commit:
        machine |= {"commit": command.commit}
    machine["versions"] |= {name: version for name in LIBRARIES if (version := _version(name))}
    facts = {
        "command": " ".join([PROGRAM, *arguments]),
        "machine": machine,
        "stand_ins": stand_ins,
        "settings": dataclasses.asdict(command) | {"out": str(command.out)},
        "frequency": drones.FREQUENCY,
    }
    print(f"{machine['device']}, JAX {machine['versions']['jax']}, empty stand-ins: {stand_ins}", flush=True)
    rows = []
    if command.peers:
        earlier = read_json(command.peers)
        rows = [row for row in earlier["rows"] if row["system"] != "openjax" and row["group"] in command.only]
        facts["peers"] = {key: earlier["machine"][key] for key in ("device", "commit", "date")}
        facts["peers"]["command"] = earlier["command"]
    for case in _cases(command):
        if case.group not in command.only or (command.peers and case.system != "openjax"):
            continue
        late = time.monotonic() - begun > command.seconds
        rows.append(_row(case, {"skipped": "time was up"} if late else _measure(case, command.min_seconds)))
        print(report.line(rows[-1]), flush=True)
        write_json(command.out / "compare.json", facts | {"rows": rows})
    facts["seconds"] = time.monotonic() - begun
    write_json(command.out / "compare.json", facts | {"rows": rows})
    (command.out / "compare.md").write_text(report.markdown(facts, rows), encoding="utf-8")
    print(f"written to {command.out}/compare.json and compare.md after {facts['seconds']:.0f} s")
    return 0


def _cases(command: CompareCommand) -> Iterator[Case]:
    """Everything, what matters most first."""
    yield from drones.cases(command.worlds, command.drones, command.steps)
    for worlds in command.training:
        yield from games.trainings(worlds, command.preset)
    yield from games.environments(command.environments, command.steps)
    middle = sorted(command.worlds)[len(command.worlds) // 2]
    yield from drones.beside(middle, command.drones, command.steps)


def _measure(case: Case, min_seconds: float) -> dict:
    begun = time.monotonic()
    try:
        function, arguments = case.make()
        made = time.monotonic() - begun
        timing = time_compiled(function, arguments, min_seconds, min_calls=5)
    except Exception as error:  # another library's failure must not cost the rest of the run
        return {"failed": f"{type(error).__name__}: {error}"[:500]}
    return {"make_seconds": made, **dataclasses.asdict(timing)}


def _row(case: Case, measured: dict) -> dict:
    """One measurement; an environment step moves one world by one step, all its agents."""
    fields = {
        field.name: getattr(case, field.name) for field in dataclasses.fields(case) if field.name != "make"
    }
    seconds = measured.get("seconds")
    speed = None if seconds is None else case.worlds * case.steps / seconds
    return fields | {
        "env_steps_per_second": speed,
        "agent_steps_per_second": None if speed is None else speed * case.agents,
        **measured,
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are results
    sys.exit(run_command(main))
