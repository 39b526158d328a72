"""The whole check on withheld causes: generate, diagnose, score, each in a process of its own.

    python experiments/withheld/run.py [--seed 101] [--scale 0.05] [--jobs N] [--work DIR] [--results PATH]
    [--baselines]

Tuning seeds are 1 to 99, reporting seeds 100 and above. A full run (--scale 1.0) writes
experiments/results/withheld.*; a smaller one writes beside its logs unless --results says otherwise.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def step(module, *arguments):
    """Run one step as `python -m experiments.withheld.MODULE` and stop if it fails."""
    paths = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    command = [sys.executable, "-m", f"experiments.withheld.{module}", *map(str, arguments)]
    print("+", " ".join(command[1:]), flush=True)
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}, check=False
    )
    if done.returncode:
        sys.exit(done.returncode)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--scale", type=float, default=0.05)
    parser.add_argument("--kinds", help="own plan, see generate.py")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--work", type=Path, default=Path("runs/withheld"), help="logs, answers, predictions; not committed"
    )
    parser.add_argument("--results", type=Path, help="path of the results without ending")
    parser.add_argument(
        "--baselines", action="store_true", help="score the two baselines on the same cases too"
    )
    options = parser.parse_args()
    full = options.scale >= 1.0 and not options.kinds
    results = options.results or (
        ROOT / "experiments/results/withheld" if full else options.work / "results" / "withheld"
    )
    logs, answers = options.work / "logs", options.work / "answers" / "answers.json"
    if logs.exists() and any(logs.iterdir()):
        sys.exit(f"{logs} already holds cases: remove it or give another --work")
    kinds = ["--kinds", options.kinds] if options.kinds else []
    step(
        "generate",
        "--seed",
        options.seed,
        "--scale",
        options.scale,
        *kinds,
        "--logs",
        logs,
        "--answers",
        answers,
        "--jobs",
        options.jobs,
    )
    results.parent.mkdir(parents=True, exist_ok=True)
    # the answers are committed to before anything is diagnosed
    Path(f"{results}_answers.sha256").write_text(answers.with_suffix(".sha256").read_text())
    predictions, reports = options.work / "predictions.json", options.work / "reports.json"
    step(
        "diagnose_all",
        "--logs",
        logs,
        "--predictions",
        predictions,
        "--reports",
        reports,
        "--jobs",
        options.jobs,
    )
    command = " ".join(["python experiments/withheld/run.py", *sys.argv[1:]])
    scoring = [
        "--answers",
        answers,
        "--predictions",
        predictions,
        "--reports",
        reports,
        "--out",
        results,
        "--command",
        command,
    ]
    step("score", *scoring)
    if options.baselines:
        step(
            "baselines",
            "--logs",
            logs,
            "--answers",
            answers,
            "--jobs",
            options.jobs,
            "--out",
            f"{results}_baselines",
        )


if __name__ == "__main__":
    main()
