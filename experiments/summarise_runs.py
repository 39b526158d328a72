"""Summary of training runs: `python -m experiments.summarise_runs OUT.json NAME=RUN ... [--note TEXT] [--commit HASH]`.

Keeps what a run's directory says of itself: settings, evaluations on the validation tasks, the layouts before and after.
Writes OUT.json and a table beside it.
"""

import argparse
import json
import statistics
from pathlib import Path

from experiments.pages import table
from openjax.store.settings_files import write_json


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


def first_reaching(evaluations: list[dict], rate: float, field: str = "capture_rate") -> str:
    """Environment steps and seconds until a validation capture rate first reaches `rate`."""
    for entry in evaluations:
        if entry.get(field, 0.0) >= rate:
            return f"{entry['steps'] / 1e6:.0f} M, {entry['seconds']:.0f} s"
    return "not reached"


def learning_against_spread(runs: dict[str, dict]) -> list[str]:
    """Improvement on the validation tasks in standard deviations over the runs' ends."""
    rows = []
    for field in ("episode_return", "collision_rate"):
        before, after = (
            [
                row[field]
                for run in runs.values()
                for row in run["layouts"][when]
                if row["scenario"] == "validation"
            ]
            for when in ("before", "after")
        )
        change = abs(statistics.mean(after) - statistics.mean(before))
        shown = ", ".join(f"{value:.3f}" for value in after)
        spread = statistics.stdev(after)
        ratio = change / spread if spread else float("inf")
        rows.append([field, f"{statistics.mean(before):.3f}", shown, f"{ratio:.1f}"])
    heads = ["figure", "before, mean", "after, each run", "improvement over standard deviation"]
    return ["", "Learning against spread, validation tasks:", "", *table(heads, rows)]


def main() -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--note", default="")
    parser.add_argument("--commit", default="")
    arguments = parser.parse_args()
    runs = {name: summary(Path(path)) for name, _, path in (run.partition("=") for run in arguments.runs)}
    write_json(arguments.out, {"note": arguments.note, "commit": arguments.commit, "runs": runs})
    lines = ["# Training runs", "", f"{arguments.note} Commit {arguments.commit}.", ""]
    far = all("far_capture_rate" in entry for run in runs.values() for entry in run["evaluations"])
    heads = ["run", "env steps", "seconds, compilation included", "of them before the first update's end"]
    heads += ["env steps/s, evaluations included", "validation capture ≥ .95", "≥ .99"]
    heads += ["far tasks ≥ .95", "≥ .99"] if far else []
    heads += ["validation capture, collisions at the end"] + (["far tasks"] if far else [])
    rows = []
    for name, run in runs.items():
        entries = run["evaluations"]
        last = entries[-1]
        cells = [name, f"{last['steps'] / 1e6:.0f} M", f"{last['seconds']:.0f}"]
        cells += [f"{run['first_update_seconds']:.0f}", f"{run['steps_per_second'] / 1e6:.2f} M"]
        kinds = ("", "far_") if far else ("",)
        cells += [first_reaching(entries, r, f"{kind}capture_rate") for kind in kinds for r in (0.95, 0.99)]
        cells += [f"{last[f'{k}capture_rate']:.3f}, {last[f'{k}collision_rate']:.4f}" for k in kinds]
        rows.append(cells)
    lines += [
        *table(heads, rows),
        "",
        "Layouts after training, evaluated on the same machine (capture rate / capture step / collision rate / "
        "crash rate):",
        "",
    ]
    names = [row["scenario"] for row in next(iter(runs.values()))["layouts"]["after"]]
    rows = []
    for name, run in runs.items():
        cells = [
            f"{row['capture_rate']:.2f} / {row['capture_step']:.0f} / {row['collision_rate']:.4f} / {row['crash_rate']:.2f}"
            for row in run["layouts"]["after"]
        ]
        rows.append([name, *cells])
    lines += table(["run", *names], rows)
    if len(runs) > 1:
        lines += learning_against_spread(runs)
    arguments.out.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
