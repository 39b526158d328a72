"""Seconds that the diagnosis of a case takes: one process, cases one after another, on a few cores.

    python -m experiments.diagnosis_time LOGS [MORE ...] [--cores 2] [--out experiments/results/diagnosis_time]

Every folder below LOGS with a vehicle.toml is a case: `experiments.exam.generate` and `experiments.exam.rotorpy_cases` make
some, and recorded flights do as well. The process starts with no compiled programs, so the first case compiles, and so do
later ones whose flights are of another length. Pictures are drawn as a user's are. What else kept the cores busy meanwhile is told by the share of
the time that this process was given of what it asked for, and by the machine's load.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path

from experiments.pages import RESULTS, facts, page_parser, table
from openjax.errors import UserError
from openjax.files import read_json
from openjax.store.settings_files import write_json

GOALS = {"median": 5.0, "slowest": 15.0, "first": 30.0}  # s; the first case apart


def time_case(folder: Path, out: Path) -> dict:
    """Seconds of each step of a case, of the clock and of the processor."""
    from openjax.flights.case import load_case
    from openjax.gap.diagnosis import diagnose_case
    from openjax.gap.report import write_report

    clock, processor, seconds = time.perf_counter(), time.process_time(), {}

    def lap(name, since):
        seconds[name] = round(time.perf_counter() - since, 2)
        return time.perf_counter()

    result = {"case": f"{folder.parent.name}/{folder.name}", "effects": None, "rows": 0}
    try:
        case = load_case(folder)
        since = lap("reading", clock)
        report = diagnose_case(case)
        evidence = report.plots["evidence"]
        seconds |= {"evidence": round(sum(evidence.seconds.values()), 2)}
        seconds["decision"] = round(time.perf_counter() - since - seconds["evidence"], 2)
        since = time.perf_counter()
        out.mkdir(parents=True)
        write_report(report, out, True)
        lap("pages", since)
        result |= {"effects": list(report.effects), "rows": sum(len(t) for t in evidence.tracks)}
    except UserError as error:  # garbage is told as such
        result["error"] = str(error)[:100]
    total = {"seconds": round(time.perf_counter() - clock, 2), "processor": round(time.process_time() - processor, 2)}
    return result | {"steps": seconds} | total


def summary(cases: list[dict]) -> dict:
    """The figures with a goal; garbage, which is refused early, apart."""
    whole = [c["seconds"] for c in cases[1:] if "error" not in c]
    return {"first": cases[0]["seconds"], "median": round(statistics.median(whole), 2), "slowest": max(whole), "cases": len(cases)}


def page(result: dict) -> str:
    """The results page."""
    names = {"first": "first case (compiles)", "median": "median of the others", "slowest": "slowest of the others"}
    rows = [[names[k], result["summary"][k], f"≤ {goal:g}"] for k, goal in GOALS.items()]
    steps = list(max((c["steps"] for c in result["cases"]), key=len))
    each = [
        [c["case"], c["rows"], *(c["steps"].get(s, "") for s in steps), c["seconds"], c["processor"],
         ", ".join(c["effects"]) or "none" if c["effects"] is not None else "refused"]
        for c in result["cases"]
    ]  # fmt: skip
    return "\n".join(
        [
            "# Seconds of a diagnosis",
            "",
            f"`{result['command']}`, commit {result['commit']}, {result['machine']}, {result['date']}. "
            f"{result['cores']} cores, load of the machine {result['load'][0]:.1f} before and {result['load'][1]:.1f} after "
            "(averages of a minute; this process alone makes 1 to 2).",
            "",
            *table(["s", "", "goal"], rows),
            "",
            *table(["case", "rows", *(f"{s}, s" for s in steps), "all, s", "of processor, s", "named"], each),
        ]
    ) + "\n"
