"""The exam from end to end: cases are drawn and flown, their answers sealed, the logs diagnosed, the answers opened.

    python -m experiments.diagnosis.run --known 60 --stranger 240 --rotorpy 3 --seed 401 --jobs 30 --work DIR [--results PATH]
    python -m experiments.diagnosis.run --plans            # writes experiments/results/exam_plans.json

Seeds below 100 are for development; the stranger's column is for reported runs. What a seed draws (categories, causes,
sensors, vehicles, missions; before anything is flown) has a digest in `exam_plans.json`, committed before the run; the
digest of the answers is on disk before the first diagnosis. A column whose `answers.json` lies in the work folder is taken as
it is, and so are diagnoses that are there whole: `generate --cases` makes a part of a plan. Needs no network and no GPU.
"""

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

from experiments.diagnosis import cases, judge, score
from experiments.pages import typed_command

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "experiments" / "results"
TITLES = {
    "stranger": "The stranger's column",
    "known": "The known column",
    "rotorpy": "RotorPy 3",
    "onboard": "On-board estimates",
}
REPORTED = {
    101: {"stranger": 240, "known": 300},
    211: {"stranger": 240, "known": 300},
    401: {"stranger": 240, "known": 60},
    503: {"stranger": 240, "known": 60},
    607: {"stranger": 240, "known": 60},
    811: {"stranger": 240, "known": 60},
}  # seed: cases; all but the last are opened


def plan_digest(seed, column, count):
    """SHA-256 of what a seed draws, numbers rounded to nine digits."""

    def plain(value):
        if isinstance(value, dict):
            return {k: plain(x) for k, x in value.items()}
        if isinstance(value, list | tuple):
            return [plain(x) for x in value]
        if hasattr(value, "__dict__"):
            return plain(vars(value))
        return float(f"{value:.9g}") if isinstance(value, float) else value

    text = json.dumps(plain(cases.draw_cases(seed, column, count)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def step(module, *arguments):
    """Run one step in a process of its own, which sees nothing of the others but files."""
    command = [sys.executable, "-m", f"experiments.diagnosis.{module}", *map(str, arguments)]
    paths = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    start = time.perf_counter()
    env = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}
    subprocess.run(command, env=env, check=True, stdout=subprocess.DEVNULL)
    print(f"{module} {time.perf_counter() - start:.0f} s", flush=True)


def facts(options):
    """Where and how the figures were made."""
    commit = (
        options.commit
        or subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, text=True).strip()
    )
    return {
        "command": typed_command(),
        "commit": commit,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "seed": options.seed,
    }


def sit(column, options, count):
    """One column: generate, seal, diagnose, score. Returns what is stored of it."""
    work = options.work / column
    logs, answers, out = work / "logs", work / "answers.json", work / "diagnoses"
    made = ["--seed", options.seed, "--logs", logs, "--answers", answers, "--jobs", options.jobs]
    if answers.exists():
        print(f"{column}: the cases in {work}", flush=True)
    elif column in ("rotorpy", "onboard"):
        step(f"{column}_cases", "--each", count, *made)
    else:
        step("generate", "--column", column, "--count", count, *made)
    digest = answers.with_suffix(".sha256").read_text().strip()
    print(f"{column}: answers {digest}", flush=True)
    limit = ["--seconds", options.seconds] if options.seconds else []
    if (out / "runs.json").exists():
        print(f"{column}: the diagnoses in {out}", flush=True)
    else:
        step("diagnose", logs, "--out", out, "--jobs", options.jobs, *limit)
    closed = None
    if column in cases.COLUMN:
        step("closed", answers, out, "--out", work / "closed.json", "--jobs", options.jobs)
        closed = json.loads((work / "closed.json").read_text())
    told, predictions = json.loads(answers.read_text())["cases"], judge.collect(out)
    missing = sorted(set(told) - set(predictions))
    result = score.score({n: a for n, a in told.items() if n in predictions}, predictions, closed)
    result |= {
        "answers_sha256": digest,
        "not_reached": missing,
        "misses": score.misses(told, result, predictions),
    }
    if column in cases.COLUMN:
        result["plan_sha256"] = plan_digest(options.seed, column, count)
    return result


def page(data, reading=""):
    """The results page: one table of all columns, the `reading` of them in words, then where each misses."""
    columns = [c for c in TITLES if c in data["columns"]]
    lines = ["# The exam of the diagnosis", ""]
    lines += [f"* {k}: `{v}`" if k == "command" else f"* {k}: {v}" for k, v in data["facts"].items()]
    for c in columns:
        r = data["columns"][c]
        said = f"* {TITLES[c]}: " + ", ".join(f"{n} {k.replace('_', ' ')}" for k, n in r["counts"].items())
        said += f"; answers {r['answers_sha256'][:16]}" + (
            f", plan {r['plan_sha256'][:16]}" if "plan_sha256" in r else ""
        )
        lines.append(
            said + (f"; {len(r['not_reached'])} cases not reached in time" if r["not_reached"] else "")
        )
    lines += ["", "Bold: the goal is reached. In brackets: 95 % interval and number of cases.", ""]
    lines += [
        "| figure | goal | " + " | ".join(TITLES[c] for c in columns) + " |",
        "|" + "---|" * (2 + len(columns)),
    ]
    for key, (what, goal, larger) in score.FIGURES.items():
        aim = "" if goal is None else f"{'≥' if larger else '≤'} {goal:g}"
        cells = [score.cell(data["columns"][c]["figures"][key], goal, larger) for c in columns]
        lines.append(f"| {what} | {aim} | " + " | ".join(cells) + " |")
    lines += ["", reading.strip()] if reading else []
    for c in columns:
        lines += ["", f"## {TITLES[c]}", "", *score.groups(data["columns"][c])]
    return "\n".join(lines) + "\n"


def draw(data, path):
    """Reliability of the probabilities and share of right answers by severity, one line per column."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    left.plot([0, 1], [0, 1], color="0.7", lw=1)
    bands = ["low", "medium", "high"]
    for c, r in data["columns"].items():
        rows = r["reliability"]
        left.plot([x["stated"] for x in rows], [x["seen"] for x in rows], "o-", label=TITLES[c])
        seen = [r["per_severity"].get(b, {}).get("value") for b in bands]
        right.plot(bands, [float("nan") if s is None else s for s in seen], "o-", label=TITLES[c])
    left.set(xlabel="probability stated", ylabel="share true", xlim=(0, 1), ylim=(0, 1.02))
    right.set(xlabel="severity (gap in noise floors)", ylabel="single causes named first", ylim=(0, 1.02))
    right.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--known", type=int, default=0, help="cases of the known column")
    parser.add_argument("--stranger", type=int, default=0, help="cases of the stranger's column")
    parser.add_argument("--rotorpy", type=int, default=0, help="cases of each kind in RotorPy")
    parser.add_argument("--onboard", type=int, default=0, help="cases of each kind on on-board estimates")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--seconds", type=float, help="time for the diagnoses of a column; what is done by then counts"
    )
    parser.add_argument(
        "--work", type=Path, default=Path("runs/exam"), help="logs and answers; not committed"
    )
    parser.add_argument("--results", type=Path, help="path of the page without ending")
    parser.add_argument("--commit", help="said on the page where git isn't there")
    parser.add_argument(
        "--report", action="store_true", help="the page again from what is stored, with NAME_reading.md in it"
    )
    parser.add_argument("--plans", action="store_true", help="write the digests of the reported runs' plans")
    options = parser.parse_args()
    if options.plans:
        plans = {
            seed: {c: {"count": n, "sha256": plan_digest(seed, c, n)} for c, n in columns.items()}
            for seed, columns in REPORTED.items()
        }
        (RESULTS / "exam_plans.json").write_text(json.dumps(plans, indent=1) + "\n")
        print(json.dumps(plans, indent=1))
        return
    if options.report:
        path = options.results or RESULTS / "exam"
        data, reading = (
            json.loads(path.with_suffix(".json").read_text()),
            path.with_name(path.name + "_reading.md"),
        )
        path.with_suffix(".md").write_text(page(data, reading.read_text() if reading.exists() else ""))
        draw(data, path.with_suffix(".png"))
        return
    wanted = {c: getattr(options, c) for c in TITLES}
    if not any(wanted.values()):
        parser.error("say how many cases: --known, --stranger, --rotorpy or --onboard")
    data = {"facts": facts(options), "columns": {}}
    results = options.results or options.work / "exam"
    results.parent.mkdir(parents=True, exist_ok=True)
    for column, count in wanted.items():
        if not count:
            continue
        data["columns"][column] = sit(column, options, count)
        results.with_suffix(".json").write_text(json.dumps(data, indent=1))
        results.with_suffix(".md").write_text(page(data))
        draw(data, results.with_suffix(".png"))
    print(page(data))


if __name__ == "__main__":
    main()
