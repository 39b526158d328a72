"""Seconds that the diagnosis of a case takes: one process, cases one after another, on a few cores.

    python -m experiments.diagnosis_time LOGS [MORE ...] [--cores 2] [--out experiments/results/diagnosis_time]

Every folder below LOGS with a vehicle.toml is a case: `experiments.diagnosis.generate` and `.rotorpy_cases` make
some, and recorded flights do as well. The process starts with no compiled programs, so the first case compiles, and so do
later ones whose flights are of another length. Pictures are drawn as a user's are.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path

# Read when NumPy and JAX are loaded: as the command does, and nothing compiled before.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

from experiments.pages import page_parser, publish, table, where
from openjax.errors import UserError

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
    total = {
        "seconds": round(time.perf_counter() - clock, 2),
        "processor": round(time.process_time() - processor, 2),
    }
    return result | {"steps": seconds} | total


def summary(cases: list[dict]) -> dict:
    """The figures with a goal; garbage, which is refused early, doesn't count."""
    whole = [c["seconds"] for c in cases if "error" not in c]
    first, others = whole[0], whole[1:]
    return {"first": first, "median": round(statistics.median(others), 2), "slowest": max(others)}


def study(options) -> dict:
    """All cases in one process on a few cores."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    folders = sorted(p.parent for logs in options.logs for p in logs.glob("*/vehicle.toml"))
    if not folders:
        raise SystemExit("no case: name folders of which each holds folders with a vehicle.toml")
    load, cases = [os.getloadavg()[0]], []
    with tempfile.TemporaryDirectory() as out:
        for number, folder in enumerate(folders):
            cases.append(time_case(folder, Path(out) / str(number)))
            print(cases[-1], flush=True)
    load.append(os.getloadavg()[0])
    return {"cores": options.cores, "load": load, "summary": summary(cases), "cases": cases}


def page(result: dict) -> list[str]:
    """The results page."""
    names = {
        "first": "first case (compiles)",
        "median": "median of the others",
        "slowest": "slowest of the others",
    }
    rows = [[names[k], f"{result['summary'][k]:.1f}", f"≤ {goal:g}"] for k, goal in GOALS.items()]
    steps = ("reading", "evidence", "decision", "pages")
    each = [
        [c["case"], str(c["rows"]), *(str(c["steps"].get(s, "")) for s in steps), str(c["seconds"]), str(c["processor"]),
         "refused" if c["effects"] is None else ", ".join(c["effects"]) or "none"]
        for c in result["cases"]
    ]  # fmt: skip
    return [
        "# Seconds of a diagnosis",
        "",
        where(result),
        "",
        f"One process on {result['cores']} cores, pictures drawn. Load of the machine (mean of a minute; this process "
        f"alone makes 1 to 2): {result['load'][0]:.1f} before, {result['load'][1]:.1f} after.",
        "",
        *table(["", "s", "goal"], rows),
        "",
        *table(["case", "rows", *(f"{s}, s" for s in steps), "all, s", "of processor, s", "named"], each),
    ]


def main() -> None:
    """Measure, and write the page."""
    parser = page_parser(__doc__, "diagnosis_time")
    parser.add_argument("logs", type=Path, nargs="*")
    parser.add_argument("--cores", type=int, default=2)
    publish(parser.parse_args(), study, page)


if __name__ == "__main__":
    main()
