"""Figures of the flying loop: `python -m experiments.flying.figures OUT [--minutes 10]`.

Everything goes through the commands that a user types, in processes of their own, with the real cflib over UDP:
* long: three virtual Crazyflies, game after game, for the minutes given: command age, missed deadlines.
* layouts: a few games on each layout: captures.
* links: flights with set-points that come late or get lost; each is a case for the diagnosis (see `diagnose`).
* simulator: the same policy on the same layouts in the simulator alone, from level starts without clamp.

`python -m experiments.flying.figures OUT --part diagnose` diagnoses the cases of an earlier run.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

LAYOUTS = ("wall", "narrow_gap", "random", "passage", "hidden")
LINKS = (
    (0.0, 0.0), (6.0, 0.0), (12.0, 0.0), (20.0, 0.0), (30.0, 0.0),
    (0.0, 0.05), (0.0, 0.1), (0.0, 0.2), (12.0, 0.05), (20.0, 0.1),
)  # fmt: skip
"""Latency (ms) and loss of the set-points."""
PORTS = 19860
"""Beyond those that cflib scans; each pair of processes has ten."""


@dataclass(frozen=True)
class Arguments:
    """Measure the flying loop."""

    out: Annotated[Path, tyro.conf.Positional]
    """Folder for logs and figures."""
    part: Literal["all", "long", "layouts", "links", "simulator", "diagnose"] = "all"
    policy: str = "flight"
    minutes: float = 10.0
    """Of the long flight."""
    at_once: int = 4
    """Pairs of processes beside the long flight's."""
    games: int = 4
    """Per link."""
    body_logs: int = 5
    """Log blocks of motors per vehicle: 5 tell the diagnosis most, 1 is what a radio carries."""
    virtual: tuple[str, ...] = ()
    """Further options of the virtual Crazyflies, as NAME=VALUE."""


LANDING = 60.0
"""Seconds that a flight has for its landing and its files, once it was asked to end."""


def pair(arguments, number: int, out: Path, virtual: str, fly: str, seconds: float) -> dict:
    """Fly with virtual Crazyflies of their own, landing after `seconds` if the games aren't over before.

    Returns what flight.json says, or why there is none.
    """
    port = PORTS + 10 * number
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1"}
    own = [f"--{option}" for option in arguments.virtual]
    command = [sys.executable, "-m", "openjax.virtual_crazyflie", "--port", str(port), *virtual.split(), *own]
    pipes = {"env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, **pipes) as vehicles:
        try:
            said = vehicles.stdout.readline()
            if "listening" not in said:
                return {"error": said}
            uris = [f"udp://127.0.0.1:{port + i}" for i in range(3)]
            command = [sys.executable, "-m", "openjax.fly", "--policy", arguments.policy, "--out", str(out)]
            command += [*fly.split(), "--body_logs", str(arguments.body_logs), "--uri", *uris]
            return flown(subprocess.Popen(command, **pipes), out, seconds)
        finally:
            vehicles.terminate()


def flown(flying, out: Path, seconds: float) -> dict:
    """What flight.json says once the process has ended, or why there is none."""
    try:
        said, _ = flying.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        flying.send_signal(signal.SIGINT)  # Ctrl-C: all land, and the log is written
        try:
            said, _ = flying.communicate(timeout=LANDING)
        except subprocess.TimeoutExpired:
            flying.kill()
            return {"error": f"not over {LANDING:g} s after it was asked to land"}
    print(out.name, " ".join(said[-2000:].split()), flush=True)
    if flying.returncode != 0 or not (out / "flight.json").exists():
        return {"error": said[-2000:]}
    return json.loads((out / "flight.json").read_text(encoding="utf-8"))


def long(arguments) -> dict:
    """One flight, game after game, until the minutes are over: then it's asked to land.

    It measures, so it goes on after stops of the machine that would land others.
    """
    options = f"--scenario wall --episodes {max(1, int(20 * arguments.minutes))} --guard_after .5"
    options += " --safety.pose_timeout .5 --safety.link_timeout 1 --safety.action_timeout .5"
    return pair(arguments, 0, arguments.out / "long", "--endurance 7200", options, 60 * arguments.minutes)


def layouts(arguments) -> dict:
    """A few games on each layout."""

    def fly(number):
        scenario = f"--scenario {LAYOUTS[number]}"
        out, games = arguments.out / f"layout_{LAYOUTS[number]}", arguments.games
        return pair(arguments, 20 + number, out, scenario, f"{scenario} --episodes {games}", 120 + 20 * games)

    with ThreadPoolExecutor(max(1, arguments.at_once // 2)) as pool:
        return dict(zip(LAYOUTS, pool.map(fly, range(len(LAYOUTS))), strict=True))


def links(arguments) -> dict:
    """One case per link."""

    def fly(number):
        latency, loss = LINKS[number]
        name, games = f"latency_{latency:g}_loss_{100 * loss:g}", arguments.games
        virtual = f"--latency_ms {latency} --loss {loss} --seed {number} --scenario random"
        options = f"--scenario random --episodes {games}"
        result = pair(arguments, 1 + number, arguments.out / name, virtual, options, 60 + 20 * games)
        return name, {"latency_ms": latency, "loss": loss, **result}

    with ThreadPoolExecutor(max(1, arguments.at_once // 2)) as pool:
        return dict(pool.map(fly, range(len(LINKS))))


def simulator(arguments) -> dict:
    """Capture steps of 20 games per layout in the simulator.

    Poses have the noise of their packets' last digits: without it all games of a layout, which begin alike, are one game.
    """
    out = arguments.out / "simulator.json"
    command = [sys.executable, "-m", "openjax.evaluate", "--policy", arguments.policy, "--episodes", "20"]
    game = {"speed_limit": "none", "substeps": "5", "start_attitude": "level", "rare_vehicles": "0.0"}
    command += [f"--environment.{name}={value}" for name, value in game.items()]
    # the nominal vehicle, as the virtual ones are
    command += ["--environment.vehicles"]
    for name, size in (("position", "0.0003"), ("velocity", "0.0003"), ("attitude", "0.001")):
        command += [f"view_noise.{name}", size, size, size, size]
    subprocess.run([*command, "--json", str(out)], check=True, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    return {row["scenario"]: row for row in json.loads(out.read_text(encoding="utf-8"))}


def diagnose(arguments, flown: dict) -> dict:
    """What `python -m openjax.diagnose` makes of the cases of `links`."""
    cases = [str(arguments.out / name) for name in flown if "error" not in flown[name]]
    predictions = arguments.out / "predictions.json"
    command = [sys.executable, "-m", "openjax.diagnose", *cases, "--out", str(arguments.out / "diagnosis")]
    command += ["--overwrite", "--predictions", str(predictions), "--no-html"]
    subprocess.run(command, check=False, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    return json.loads(predictions.read_text(encoding="utf-8"))


def main() -> None:
    arguments = tyro.cli(Arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "figures.json"
    figures = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    parts = ("long", "layouts", "links", "simulator") if arguments.part == "all" else (arguments.part,)
    work = {"long": long, "layouts": layouts, "links": links, "simulator": simulator}

    def run(part):
        figures[part] = work[part](arguments)
        path.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")

    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(run, [part for part in parts if part in work]))
    if arguments.part == "diagnose":
        figures["diagnosis"] = diagnose(arguments, figures["links"])
    path.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
