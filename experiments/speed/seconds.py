"""Seconds to the first update, and to a policy that catches: `python -m experiments.speed.seconds
[--starts paper] [--seeds 1]`.

Runs of `openjax train`, one after the other. Each of `--starts`, a preset and its options in
quotes, is run twice, until its first validation: first with nothing kept, then with compiled
programs and traces kept. Then each of `--seeds` flies the first of them, all kept, until a
validation is what is asked for (`--whole`: to its end, `--cold`: with nothing kept). Results are
written after each run; `--go_on` adds to those that are there, and finds what was kept in the same
`--cache`.
"""

import argparse
import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from experiments.table import Page, Table, facts, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json, to_plain, write_json
from openjax.pursuit import SCENARIOS
from openjax.show.metrics import METRICS_FILE, read_metrics


def good(validation: dict) -> bool:
    """Whether a validation on uniform tasks is what is asked for."""
    return validation["capture_rate"] >= 0.99 and validation["crash_rate"] <= 0.01


class Runner:
    """Flies runs, until there is no time left."""

    def __init__(self, options: argparse.Namespace):
        self.cache = options.cache
        self.longest = options.longest
        self.cold = options.cold
        self.ends = time.monotonic() + options.limit
        self.enough = (lambda validation: False) if options.whole else good

    def all(self, starts: list[str], seeds: list[int]) -> Iterator[dict]:
        """The runs that are still to be had, the most telling first."""
        for start in [] if self.cold else starts:
            for _ in range(1 if seeds and start == starts[0] else 2):
                yield from self.fly(start, (seeds or [0])[0], lambda validation: True)
        for seed in seeds:
            yield from self.fly(starts[0], seed, self.enough)

    def fly(self, start: str, seed: int, enough: Callable[[dict], bool]) -> Iterator[dict]:
        """One run's curve, until a validation is enough; nothing where the time is over."""
        if time.monotonic() >= self.ends:
            return
        cache = self.cache / re.sub(r"\W+", "_", f"{start} {seed if self.cold else ''}")
        cached = "all" if cache.exists() else "nothing"
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            process = begin(start, seed, out, cache)
            file = out / METRICS_FILE
            ends = min(self.ends, time.monotonic() + self.longest)
            while process.poll() is None and not any(map(enough, validations(file))):
                if time.monotonic() > ends:
                    break
                time.sleep(0.2)
            if process.poll():
                raise RuntimeError(out.with_suffix(".log").read_text()[-2000:])
            end(process)
            if not validations(file):  # what was kept isn't all
                shutil.rmtree(cache, ignore_errors=True)
            yield {"start": start, "seed": seed, "kept": cached, **curve(file), "whole": whole(out)}


def begin(start: str, seed: int, out: Path, cache: Path) -> subprocess.Popen:
    """A run as a process, which keeps programs in a folder of its own."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "openjax.train", "--preset", *shlex.split(start)]
    command += ["--seed", str(seed), "--compare_with", "none", "--out", str(out)]
    with open(out.with_suffix(".log"), "w") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)


def end(process: subprocess.Popen) -> None:
    """Ask a process to save within 10 s and end; what it compiles in the background isn't waited
    for.
    """
    process.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(10.0)
    process.kill()
    process.wait()


def validations(file: Path) -> list[dict]:
    """What a run's validations have said so far."""
    return list(read_metrics(file, "validation")) if file.exists() else []


def curve(file: Path) -> dict:
    """First update, updates a second and validations of a run, from its metrics."""
    trained = list(read_metrics(file, "train")) if file.exists() else []
    steps, seconds = (
        np.diff([update[name] for update in trained]) for name in ("steps", "seconds")
    )
    return {
        "first_update": trained[0]["seconds"] if trained else None,
        "update": float(np.median(seconds)) if len(seconds) else None,
        "steps_per_second": float(np.median(steps) / np.median(seconds)) if len(seconds) else None,
        "validations": validations(file),
    }


def whole(out: Path) -> dict | None:
    """Seconds of a run that came to its end; capture rate, crash rate and steps to the capture by
    layout.
    """
    if not (out / "layouts.json").exists():
        return None
    told = read_json(out / "layouts.json")
    rates = ("capture_rate", "crash_rate", "capture_step")
    layouts = {
        r["scenario"]: [r[rate] for rate in rates]
        for r in told["after"]
        if r["scenario"] in SCENARIOS
    }
    captures, crashes, _ = zip(*layouts.values(), strict=True)
    return {
        "seconds": told["seconds"],
        "least": min(captures),
        "most": max(crashes),
        "layouts": layouts,
    }


def study(options: argparse.Namespace) -> dict:
    """All runs; they are stored after each, for `--report`."""
    path = options.out.with_suffix(".json")
    runs = read_json(path)["runs"] if options.go_on and path.exists() else []
    results = {"note": options.note, "runs": runs}
    with tempfile.TemporaryDirectory() as folder:
        options.cache = options.cache or Path(folder)
        for run in Runner(options).all(options.starts, options.seeds):
            runs.append(run)
            write_json(path, to_plain({**facts(options.commit), **results}))
    return results


def page(results: dict) -> Page:
    """A row per run, and the median of those that found all kept."""
    rows = [
        {
            **run,
            "reached": next(filter(good, run["validations"]), None),
            "last": (run["validations"] or [None])[-1],
        }
        for run in results["runs"]
    ]
    columns = {
        "preset and options": "start",
        "seed": "seed",
        "kept": "kept",
        "first update, s": "first_update:.1f",
        "an update, s": "update:.3f",
        "env steps/s of updates": "steps_per_second:,.0f",
        "≥ .99 caught, ≤ .01 crash after, s": "reached.seconds:.1f",
        "env steps until then": "reached.steps:,",
        "then collisions": "reached.collision_rate:.4f",
        "caught in the last validation": "last.capture_rate:.3f",
        "whole run, s": "whole.seconds:.1f",
        "least caught in a layout": "whole.least:.2f",
        "most crash": "whole.most:.2f",
    }
    prose = f"Uniform validation tasks. An update is the median of a run's. {results['note']}"
    goals = [
        goal for goal in results.get("goals", []) if "evaders.md" not in goal["page or command"]
    ]
    short = Table({name: name for name in ("figure", "goal", "value")}, goals)
    return Page("Seconds to a policy that catches", prose, Table(columns, rows, "Runs"), short)


def main(arguments: list[str]) -> int:
    """Fly the runs, write both files."""
    parser = page_parser(__doc__, "seconds")
    parser.add_argument(
        "--starts", nargs="+", default=["paper"], help="presets, each with its options"
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of runs until they catch")
    parser.add_argument("--whole", action="store_true", help="run those to their end")
    parser.add_argument(
        "--cold", action="store_true", help="run only those, each with nothing kept"
    )
    parser.add_argument(
        "--limit", type=float, default=float("inf"), help="s after which all is over"
    )
    parser.add_argument("--longest", type=float, default=200.0, help="s that one run may take")
    parser.add_argument(
        "--cache", type=Path, help="where programs are kept; by default for these runs alone"
    )
    parser.add_argument("--go_on", action="store_true", help="add to the results that are there")
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
