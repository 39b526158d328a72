"""Seconds to a policy that catches: `python -m experiments.speed.seconds --seeds 171 172 173 [--preset paper] [--options "..."]`.

Runs of `openjax train`, one after the other. The first seed's has nothing kept and goes to its end. Then each seed's finds
compiled programs and traces, and is stopped once two validations are what is asked for. Then whole runs, while there is time.
Writes experiments/results/seconds.json and .md after each run.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.table import Page, Table, facts, page_parser, publish, write_page
from openjax.commands.command_line import run_command
from openjax.files import read_json, to_plain, write_json
from openjax.show.metrics import METRICS_FILE, read_metrics

CAPTURED, CRASHED = 0.99, 0.01
"""Rates of the uniform validation tasks that are asked for."""
SURE = 2
"""Validations after which a run is stopped that needn't go to its end."""


def good(validation: dict) -> bool:
    """Whether a validation is what is asked for."""
    return validation["capture_rate"] >= CAPTURED and validation["crash_rate"] <= CRASHED


def fly(options: argparse.Namespace, scratch: Path, seed: int, whole: bool) -> dict:
    """A run's curve; of a whole one the layouts' table, too."""
    run = scratch / f"run_{len(list(scratch.iterdir()))}_seed_{seed}"
    environment = {**os.environ, "XDG_CACHE_HOME": str(scratch / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "openjax.train", "--preset", options.preset, "--seed", str(seed)]
    command += ["--compare_with", "none", "--out", str(run), *options.options.split()]
    with open(f"{run}.log", "w") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
    began, file = time.monotonic(), run / METRICS_FILE
    validations: list[dict] = []
    while process.poll() is None:
        time.sleep(0.5)
        validations = list(read_metrics(file, "validation")) if file.exists() else []
        late = time.monotonic() - began > options.longest
        if not whole and (sum(map(good, validations)) >= SURE or late):
            process.send_signal(signal.SIGTERM)
            process.wait()
    trained = list(read_metrics(file, "train")) if file.exists() else []
    steps, seconds = (trained[-1][k] - trained[0][k] if trained else 0.0 for k in ("steps", "seconds"))
    layouts = run / "layouts.json"
    return {
        "seed": seed,
        "first_update": trained[0]["seconds"] if trained else None,
        "steps_per_second": steps / seconds if seconds else None,
        "evaluations": list(read_metrics(file, "validation")) if file.exists() else [],
        "layouts": read_json(layouts)["after"] if layouts.exists() else [],
    }


def runs(options: argparse.Namespace, scratch: Path) -> Iterator[dict]:
    """All runs, until there is no time for another."""
    began, first = time.monotonic(), options.seeds[0]
    wanted = [(first, "nothing", True), *((seed, "all", False) for seed in options.seeds)]
    for seed, kept, whole in wanted + [(seed, "all", True) for seed in options.seeds[1:]]:
        if time.monotonic() - began < options.limit:
            yield {"kept": kept, "whole": whole, **fly(options, scratch, seed, whole)}


def study(options: argparse.Namespace) -> dict:
    """All runs; the page is written after each."""
    results = {"preset": options.preset, "note": options.note, "runs": []}
    with tempfile.TemporaryDirectory() as folder:
        for run in runs(options, Path(folder)):
            results["runs"].append(run)
            stored = to_plain({**facts(options.commit), **results})
            write_json(options.out.with_suffix(".json"), stored)
            write_page(options.out, page, stored)
    return results


def page(results: dict) -> Page:
    """A row per run; the layouts of the whole ones."""
    rows = [{**run, "reached": next(filter(good, run["evaluations"]), None)} for run in results["runs"]]
    columns = {
        "seed": "seed",
        "kept": "kept",
        "first update of MAPPO, s": "first_update:.1f",
        "≥ .99 caught, ≤ .01 crash after, s": "reached.seconds:.1f",
        "steps of MAPPO until then": "reached.steps:,",
        "then collisions": "reached.collision_rate:.4f",
        "env steps/s, evaluations included": "steps_per_second:,.0f",
    }
    kept = [
        run["reached"]["seconds"]
        for run in rows
        if run["reached"] and run["kept"] == "all" and not run["whole"]
    ]
    prose = f"Preset `{results['preset']}`, validation tasks. {results['note']}"
    if kept:
        prose += f" With all kept, the median of {len(kept)} seeds is {np.median(kept):.1f} s, the slowest {max(kept):.1f} s."
    parts = [Table(columns, rows)]
    flown = [{"of seed": run["seed"], **layout} for run in rows for layout in run["layouts"]]
    if flown:
        columns = {"seed": "of seed", "tasks": "scenario", "capture rate": "capture_rate:.2f"}
        columns |= {
            "capture step": "capture_step:.0f",
            "collision rate": "collision_rate:.4f",
            "crash rate": "crash_rate:.2f",
        }
        parts.append(Table(columns, flown, "After the whole run"))
    return Page("Seconds to a policy that catches", prose, parts)


def main(arguments: list[str]) -> int:
    """Fly the runs, write both files."""
    parser = page_parser(__doc__, "seconds")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--seeds", type=int, nargs="+", default=[171, 172, 173, 174, 175])
    parser.add_argument("--options", default="", help="more options of openjax.train")
    parser.add_argument("--limit", type=float, default=float("inf"), help="s after which no run begins")
    parser.add_argument(
        "--longest", type=float, default=120.0, help="s that a run may take which isn't whole"
    )
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
