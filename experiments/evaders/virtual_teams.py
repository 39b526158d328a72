"""Teams of one to eight virtual Crazyflies: `python -m experiments.evaders.virtual_teams
--json FILE`.

Flies each size of team as anybody would, `openjax fly` against `openjax
virtual_crazyflie` through the real `cflib` in real time, while packets are lost both
ways. Starts and pillars are those of a uniform task for each size. Counted is who
was caught, whether all came down because they were asked to, and how late commands were.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

from openjax.files import read_json, write_json
from openjax.pursuit import PursuitSettings, uniform_task
from openjax.runs.machine import describe_machine
from openjax.store import TEAM_POLICY
from openjax.store.policies import load_policy

PORT = 20250
"""Of the first vehicle, by default; none that a virtual Crazyflie has by itself."""
LONGEST = 240.0
"""Seconds after which a flight that doesn't end is ended."""
OPENJAX = [sys.executable, "-m", "openjax"]
ASKED = "asked to land"
"""A vehicle's reason to come down where nothing went wrong."""


def layout(game: PursuitSettings, seed: int) -> str:
    """A uniform task of a game as a layout's TOML."""
    task = uniform_task(game, jax.random.key(seed))
    pillars = np.asarray(task.pillar_position)[np.asarray(task.pillar_active)]
    entries = {
        "pillars": pillars[:, :2],
        "pursuers": np.asarray(task.pursuer_position),
        "evader": np.asarray(task.evader_position),
    }
    lines = (
        f"{name} = {np.round(value.astype(float), 3).tolist()}" for name, value in entries.items()
    )
    return "\n".join(lines) + "\n"


def fly(size: int, options: argparse.Namespace, folder: Path) -> dict:
    """What became of the games of one size."""
    game = load_policy(options.policy).settings.environment.of_one_team(size)
    starts = folder / f"team_{size}.toml"
    starts.write_text(layout(game, options.seed))
    place = ["--scenario", str(starts)]
    virtual = listening(size, place, options)
    try:
        out = folder / f"flight_{size}"
        uris = [f"udp://127.0.0.1:{options.port + i}" for i in range(size)]
        command = ["fly", "--policy", options.policy, *place]
        command += ["--out", str(out), "--episodes", str(options.episodes)]
        command += ["--body_logs", str(options.body_logs)]
        flown = subprocess.run(
            [*OPENJAX, *command, "--uri", *uris], capture_output=True, text=True, timeout=LONGEST
        )
    finally:
        virtual.send_signal(signal.SIGINT)
        virtual.wait()
    if not (out / "flight.json").is_file():
        raise RuntimeError((flown.stdout + flown.stderr).strip())
    return {"pursuers": size, "status": flown.returncode, **summary(out)}


def listening(size: int, place: list[str], options: argparse.Namespace) -> subprocess.Popen:
    """The virtual Crazyflies' process, once it listens."""
    command = ["virtual_crazyflie", "--number", str(size), "--port", str(options.port)]
    command += ["--loss", str(options.loss), "--pose_loss", str(options.pose_loss)]
    process = subprocess.Popen([*OPENJAX, *command, *place], stdout=subprocess.PIPE, text=True)
    # its first line says that it listens; before that there is nobody to fly
    said = process.stdout.readline()
    if "listening" not in said:
        process.send_signal(signal.SIGINT)
        process.wait()
        raise RuntimeError(f"virtual_crazyflie: {said.strip()}")
    return process


def summary(out: Path) -> dict:
    """Of a flight's folder: games, captures, steps with a breach, who was asked to
    land, and how late commands were.
    """
    flight = read_json(out / "flight.json")
    games = flight["games"]
    steps = [game["capture_step"] for game in games if game["capture_step"]]
    timing = flight["timing"]
    return {
        "games": len(games),
        "captures": len(steps),
        "capture_steps": steps,
        "breaches": [game["breaches"] for game in games],
        "landed_as_asked": sum(reason == ASKED for reason in flight["reasons"]),
        "reasons": sorted(set(flight["reasons"])),
        "command_age_ms": timing["command_age_ms"],
        "missed_share": timing["missed_share"],
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", default=TEAM_POLICY)
    parser.add_argument("--sizes", nargs="+", type=int, default=list(range(1, 9)))
    parser.add_argument("--episodes", type=int, default=3, help="games of each size")
    parser.add_argument("--loss", type=float, default=0.2, help="of the set-points")
    parser.add_argument(
        "--pose_loss",
        type=float,
        default=0.05,
        help="of the poses; with a fifth of them lost openjax fly doesn't take off",
    )
    parser.add_argument("--seed", type=int, default=0, help="draws starts and pillars")
    parser.add_argument(
        "--port", type=int, default=PORT, help="others, to fly beside another of these"
    )
    parser.add_argument(
        "--body_logs",
        type=int,
        default=1,
        help="blocks of motors and accelerometer that each logs, as over a radio",
    )
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    loss = {"set-points": options.loss, "poses": options.pose_loss}
    found = {"loss": loss, "machine": describe_machine(), "teams": []}
    with tempfile.TemporaryDirectory() as folder:
        for size in options.sizes:
            found["teams"].append(fly(size, options, Path(folder)))
            print(found["teams"][-1], flush=True)
            write_json(options.json, found)


if __name__ == "__main__":
    main()
