"""Seconds to a policy that catches: `python -m experiments.speed.seconds --seeds 171 172 173 [--preset paper] [--options "..."]`.

Whole runs of `openjax train`, one after the other; the first of them once more before, with nothing kept, so that the others find
compiled programs and traces. Writes experiments/results/seconds.json and .md.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.paper.summarise_runs import summary
from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.errors import UserError

CAPTURED, CRASHED = 0.99, 0.01
"""Rates of the uniform validation tasks that count as reached."""


def train(options: argparse.Namespace, scratch: Path, name: str, seed: int, *more: str) -> dict:
    """A run's curve, and its table of the layouts.

    Raises:
      UserError: it ended without one.
    """
    run = scratch / name
    environment = {**os.environ, "XDG_CACHE_HOME": str(scratch / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "openjax.train", "--preset", options.preset, "--seed", str(seed)]
    command += ["--compare_with", "none", "--out", str(run), *options.options.split(), *more]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    if not (run / "layouts.json").exists():
        raise UserError(f"run {name} ended with status {ended.returncode}: {ended.stderr[-300:].strip()}")
    told = summary(run)
    told.pop("settings")
    return {"name": name, "seed": seed, **told}


def study(options: argparse.Namespace) -> dict:
    """All runs."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        scratch, first = Path(folder), options.seeds[0]
        runs = [train(options, scratch, f"{first}, nothing kept", first, *options.cold.split())]
        for seed in options.seeds:
            if time.monotonic() - started < options.limit:
                runs.append(train(options, scratch, str(seed), seed))
    return {"preset": options.preset, "note": options.note, "runs": runs}


def reached(run: dict) -> dict | None:
    """The first validation with the captures and the crashes that are asked for."""
    fit = (v for v in run["evaluations"] if v["capture_rate"] >= CAPTURED and v["crash_rate"] <= CRASHED)
    return next(fit, None)


def page(results: dict) -> Page:
    """A row per run, and its layouts."""
    runs = [{**run, "reached": reached(run), "last": run["evaluations"][-1]} for run in results["runs"]]
    captured = {"≥ .99 caught after, s": lambda run: _first(run, lambda v: v["capture_rate"] >= CAPTURED)}
    columns = {"seed": "name", "first update, s": "first_update_seconds:.1f"} | captured
    columns |= {
        "... and ≤ .01 crash, s": "reached.seconds:.0f",
        "after steps, M": lambda run: f"{run['reached']['steps'] / 1e6:.0f}" if run["reached"] else "–",
        "steps/s, M": lambda run: f"{run['steps_per_second'] / 1e6:.2f}",
        "end, s": "last.seconds:.0f",
        "capture, crash, collision rate": lambda run: _rates(run["last"]),
    }
    kept = [run["reached"]["seconds"] for run in runs[1:] if run["reached"]]
    prose = f"Preset `{results['preset']}`. {results['note']} "
    if len(kept) == len(runs) - 1:
        prose += f"With all kept, the median of {len(kept)} seeds is {np.median(kept):.0f} s, the slowest {max(kept):.0f} s."
    names = [row["scenario"] for row in runs[0]["layouts"]["after"]]
    by_layout = {"seed": "name"} | {
        f"`{name}`": lambda run, i=i: _rates(run["layouts"]["after"][i], "capture_step")
        for i, name in enumerate(names)
    }
    flown = Table(
        by_layout, runs, "After the training", "Capture rate, crash rate, collision rate, capture step."
    )
    return Page("Seconds to a policy that catches", prose, (Table(columns, runs), flown))


def _first(run, fits):
    return next((f"{entry['seconds']:.0f}" for entry in run["evaluations"] if fits(entry)), "–")


def _rates(record, *more):
    parts = [
        f"{record['capture_rate']:.2f}",
        f"{record['crash_rate']:.2f}",
        f"{record['collision_rate']:.4f}",
    ]
    return ", ".join([*parts, *(f"{record[name]:.0f}" for name in more)])


def main(arguments: list[str]) -> int:
    """Fly the runs, write both files."""
    parser = page_parser(__doc__, "seconds")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--seeds", type=int, nargs="+", default=[171, 172, 173, 174, 175])
    parser.add_argument("--options", default="", help="more options of openjax.train")
    parser.add_argument("--cold", default="", help="more options of the run with nothing kept")
    parser.add_argument(
        "--limit", type=float, default=float("inf"), help="s after which no further run begins"
    )
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
