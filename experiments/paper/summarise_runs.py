"""Summary of training runs: `python -m experiments.paper.summarise_runs NAME=RUN ... [--out OUT] [--note TEXT]`.

Keeps what a run's directory says of itself: settings, evaluations on the validation tasks, the layouts before and after.
Writes experiments/results/h200_runs.json and .md, or OUT's; `--report` writes the latter again from the former.
"""

import json
from pathlib import Path

from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command


def summary(run: Path) -> dict:
    """Settings, evaluations and layouts of one run."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    trained = [line for line in lines if line["event"] == "train"]
    first, last = trained[0], trained[-1]
    return {
        "settings": json.loads((run / "settings.json").read_text(encoding="utf-8")),
        "first_update_seconds": first["seconds"],
        "steps_per_second": (last["steps"] - first["steps"]) / max(last["seconds"] - first["seconds"], 1e-9),
        "evaluations": [line for line in lines if line["event"] == "validation"],
        "layouts": json.loads((run / "layouts.json").read_text(encoding="utf-8")),
    }


def first_reaching(evaluations: list[dict], rate: float) -> str:
    """Environment steps and seconds until a validation capture rate first reaches `rate`."""
    for entry in evaluations:
        if entry["capture_rate"] >= rate:
            return f"{entry['steps'] / 1e6:.0f} M, {entry['seconds']:.0f} s"
    return "not reached"


def page(results: dict) -> Page:
    """How long the runs were, and how good their policies."""
    runs = [{"run": name, "last": run["evaluations"][-1], **run} for name, run in results["runs"].items()]
    columns = {
        "run": "run",
        "env steps": lambda run: f"{run['last']['steps'] / 1e6:.0f} M",
        "seconds, compilation included": "last.seconds:.0f",
        "before the first update's end": "first_update_seconds:.0f",
        "env steps/s, evaluations included": lambda run: f"{run['steps_per_second'] / 1e6:.2f} M",
        "validation capture ≥ .95": lambda run: first_reaching(run["evaluations"], 0.95),
        "≥ .99": lambda run: first_reaching(run["evaluations"], 0.99),
        "capture at the end": "last.capture_rate:.3f",
        "collisions": "last.collision_rate:.4f",
    }
    flown = [{"run": run["run"], **row} for run in runs for row in run["layouts"]["after"]]
    after = {
        "run": "run",
        "tasks": "scenario",
        "capture rate": "capture_rate:.2f",
        "capture step": "capture_step:.0f",
        "collision rate": "collision_rate:.4f",
        "crash rate": "crash_rate:.2f",
    }
    return Page(
        "Training runs", results["note"], (Table(columns, runs), Table(after, flown, "After the training"))
    )


def study(options) -> dict:
    """Read the runs."""
    runs = {name: summary(Path(path)) for name, _, path in (run.partition("=") for run in options.runs)}
    return {"note": options.note, "runs": runs}


def main(arguments: list[str]) -> int:
    """Write both files."""
    parser = page_parser(__doc__, "h200_runs")
    parser.add_argument("runs", nargs="*", help="NAME=DIRECTORY")
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
