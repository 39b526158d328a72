"""Hostile input, damaged checkpoints, kills at any instant: what openjax makes of them.

    python -m experiments.fuzz [--cases 10000] [--damages 200] [--kills 30] [--workers N] [--out experiments/results/fuzz]

* Cases, in process, seeds fixed: command lines, settings, layouts, effects, vehicles, logs and policy files, changed
  at random. Each must be refused in one line or accepted with sane values; a traceback, an odd value that is accepted,
  a file left behind, 30 s or 1 GB more of memory is a failure.
* Damages: a checkpoint of a tiny run gets bits flipped, bytes cut, files deleted; what is restored must be bit for bit
  what was saved in it or in the one before.
* Kills: a tiny training run is killed (SIGKILL) at instants spread over its whole life; `--resume`, or where there is
  nothing to resume the same command, must bring it to the bits of the run that nobody killed.

A part whose number is 0 is left out; what an earlier call found of it stays in the results.
"""

import dataclasses
import json
import os
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import tyro

from experiments.fuzz.cases import plan, try_cases
from experiments.fuzz.damages import make_checkpoints, try_damages
from experiments.fuzz.kills import instants, try_kill, undisturbed
from experiments.fuzz.report import page
from experiments.pages import facts
from openjax.commands.command_line import quiet_libraries
from openjax.files import read_json
from openjax.store.settings_files import write_json


@dataclasses.dataclass(frozen=True)
class FuzzCommand:
    """Try hostile input, damaged checkpoints and kills."""

    cases: int = 10_000
    """Changed inputs."""
    damages: int = 200
    """Damaged checkpoints."""
    kills: int = 30
    """Instants at which a run is killed."""
    updates: int = 200
    """Updates of the run that is killed."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    seed: int = 0
    out: Path = Path(__file__).parents[1] / "results" / "fuzz"
    """Results are written to this path with .json and .md."""


class Results:
    """What is known by now, on disk after each addition, so that an interrupted run leaves it."""

    def __init__(self, out: Path):
        self.out, self.parts = out, {}
        if out.with_suffix(".json").exists():
            self.parts = read_json(out.with_suffix(".json"))
        self.started = time.monotonic()
        self.facts = facts()

    def put(self, part: str, found: dict) -> None:
        """What this call found of a part, in place of what an earlier one did."""
        seconds = round(time.monotonic() - self.started)
        self.parts[part] = {**found, **self.facts, "seconds": seconds}
        write_json(self.out.with_suffix(".json"), self.parts)
        self.out.with_suffix(".md").write_text(page(self.parts), encoding="utf-8")
        print(f"{part}, {seconds} s: {json.dumps(found)[:400]}", flush=True)


def run_cases(pool: ProcessPoolExecutor, command: FuzzCommand, results: Results) -> None:
    """Changed inputs, in pieces that one process does at a time."""
    pieces = [pool.submit(try_cases, *piece) for piece in plan(command.cases, command.seed)]
    counts: dict[str, Counter] = {}
    failures = []
    for done, piece in enumerate(as_completed(pieces), 1):
        for kind, seed, outcome, text in piece.result():
            counts.setdefault(kind, Counter())[outcome] += 1
            if outcome == "failed":
                failures.append({"kind": kind, "seed": seed, "text": text})
        if done % 50 == 0 or done == len(pieces):
            found = {kind: dict(count) for kind, count in sorted(counts.items())}
            results.put("cases", {"counts": found, "failures": failures})


def run_damages(pool: ProcessPoolExecutor, scratch: Path, command: FuzzCommand, results: Results) -> None:
    """Damaged checkpoints."""
    make_checkpoints(scratch)
    pieces = [
        pool.submit(try_damages, scratch, range(first, min(first + 20, command.damages)))
        for first in range(0, command.damages, 20)
    ]
    outcomes: Counter = Counter()
    for piece in as_completed(pieces):
        outcomes.update(piece.result())
        results.put("damages", {"outcomes": dict(outcomes)})


def run_kills(pool: ProcessPoolExecutor, scratch: Path, command: FuzzCommand, results: Results) -> None:
    """Killed runs, in an order in which the first few already cover the whole life of a run."""
    cache = scratch / "cache"
    expected, seconds = undisturbed(scratch, command.updates, cache)
    kills = [
        pool.submit(try_kill, scratch, command.updates, instant, expected, cache)
        for instant in instants(seconds, command.kills)
    ]
    found = []
    for kill in as_completed(kills):
        found.append(kill.result())
        tries = sorted(found, key=lambda facts: facts["seconds"])
        results.put("kills", {"whole_run": round(seconds, 1), "tries": tries})


def main(command: FuzzCommand) -> dict:
    """Everything that was asked for; returns the results that are written."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=1")
    results = Results(command.out)
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(command.workers, get_context("spawn"), quiet_libraries) as pool,
    ):
        if command.cases:
            run_cases(pool, command, results)
        if command.damages:
            run_damages(pool, Path(folder), command, results)
        if command.kills:
            run_kills(pool, Path(folder), command, results)
    return results.parts


if __name__ == "__main__":
    main(tyro.cli(FuzzCommand))
