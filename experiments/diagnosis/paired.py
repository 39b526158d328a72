"""The same cases by several engines: figures of each, and whether they differ, case by case.

    python -m experiments.diagnosis.paired --seeds 2301 2302 2303 --count 120 --cores 64
    --engines now=src before=FOLDER/src --work DIR --out FILE.json [--healthy] [--sets DIR ...]

Cases of one column are flown anew from the seeds, beside the sets that are given. An engine is a
folder that holds the package `openjax`; `NAME=FOLDER+reference` gives it the flights of the same
vehicle while nothing was wrong with it, flown with `--healthy`. Differences of two engines are
tested by McNemar's exact test on the cases that only one of them has right.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from scipy.stats import binomtest

from experiments.diagnosis.development import read_lines
from experiments.diagnosis.figures import CATEGORIES, figures_table
from experiments.diagnosis.run import ROOT, stored_figures


def fly(seed: int, options) -> tuple[Path, str]:
    """Fly the cases of a seed in a process of its own; their folder, the SHA-256 of the answers."""
    logs = options.work / f"{options.column}_{seed}"
    answers = logs.with_name(logs.name + "_answers.json")
    if not answers.exists():
        command = [sys.executable, "-m", "experiments.diagnosis.generate", "--seed", str(seed)]
        command += ["--column", options.column, "--count", str(options.count)]
        command += ["--logs", str(logs), "--answers", str(answers), "--jobs", str(options.cores)]
        command += ["--healthy"] if options.healthy else []
        subprocess.run(command, cwd=ROOT, check=True)
    return logs, answers.with_suffix(".sha256").read_text().strip()


def diagnose(name: str, engine: str, sets: list[str], options) -> list[dict]:
    """The lines of all cases by one engine."""
    source, _, reference = engine.partition("+")
    # an older engine runs its own runner
    older = Path(source).resolve().parent / "experiments"
    here = ROOT if ROOT / "experiments" == older or not older.exists() else older.parent
    out = options.work.resolve() / f"{name}.jsonl"
    command = [sys.executable, "-m", "experiments.diagnosis.development", "--sets", *sets]
    command += ["--cores", str(options.cores), "--out", str(out)]
    command += ["--healthy"] if reference else []
    command += ["--seconds", str(options.seconds)] if options.seconds else []
    environment = dict(os.environ, PYTHONPATH=str(Path(source).resolve()))
    subprocess.run(command, cwd=here, check=True, env=environment)
    return read_lines([out])


def mcnemar(one: list[dict], other: list[dict]) -> dict[str, dict]:
    """{figure: cases that only one engine has right, and the exact two-sided p-value}."""
    second = {(r["set"], r["case"]): r for r in other}
    both = [(r, second[key]) for r in one if (key := (r["set"], r["case"])) in second]
    tests = {n: (c, lambda r: r["right"]) for n, c in CATEGORIES.items()}
    tests["wrong_name"] = ("unknown", lambda r: not r["wrong_names"])
    tests["nothing_else"] = ("single", lambda r: not r["wrong_names"])
    out = {}
    for figure, (category, key) in tests.items():
        pairs = [(key(a), key(b)) for a, b in both if a["category"] == category]
        gained = sum(a and not b for a, b in pairs)
        lost = sum(b and not a for a, b in pairs)
        p = binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
        out[figure] = {"n": len(pairs), "gained": gained, "lost": lost, "p": round(float(p), 4)}
    return out


# What days move as well: of these a reference of one other day tells only what is
# larger.
DRIFTING = ("com_offset", "motor_imbalance", "mass", "thrust_scale")
LEFT_OUT = ("quality", "not_testable", "rest", "parameters", "gap", "probabilities")


def study(options) -> dict:
    """Fly, diagnose by every engine, compare."""
    options.work.mkdir(parents=True, exist_ok=True)
    flown = [fly(seed, options) for seed in options.seeds]
    sets = [str(logs.resolve()) for logs, _ in flown] + options.sets
    engines = dict(entry.split("=", 1) for entry in options.engines)
    lines = {n: diagnose(n, engine, sets, options) for n, engine in engines.items()}
    for name, found in lines.items():
        print("\n".join([f"## {name}", *figures_table([r | {"set": name} for r in found])]))
    first, *others = engines
    compared = {f"{first} against {o}": mcnemar(lines[first], lines[o]) for o in others}
    print(json.dumps(compared, indent=1))
    return {
        "seeds": options.seeds,
        "column": options.column,
        "answers_sha256": {str(s): d for s, (_, d) in zip(options.seeds, flown, strict=True)},
        "figures": {n: stored_figures(found) for n, found in lines.items()},
        "by_set": {
            n: {s: stored_figures([r for r in found if r["set"] == s]) for s in _sets(found)}
            for n, found in lines.items()
        },
        "beyond_days": {n: beyond_days(found) for n, found in lines.items()},
        "compared": compared,
        "cases": {
            n: [{k: v for k, v in r.items() if k not in LEFT_OUT} for r in found]
            for n, found in lines.items()
        },
    }


def beyond_days(lines: list[dict]) -> dict:
    """First names of single causes that a day's drift of trims and thrust can't make."""
    asked = [r for r in lines if r["category"] == "single" and not set(r["truth"]) & set(DRIFTING)]
    return {"hits": sum(r["right"] for r in asked), "n": len(asked)}


def _sets(lines: list[dict]) -> list[str]:
    return sorted({r["set"] for r in lines})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="*", type=int, default=[])
    parser.add_argument("--column", default="stranger")
    parser.add_argument("--count", type=int, default=120)
    parser.add_argument("--sets", nargs="*", default=[], metavar="DIR[=ANSWERS]")
    parser.add_argument("--engines", nargs="+", required=True, metavar="NAME=FOLDER[+reference]")
    parser.add_argument("--healthy", action="store_true", help="fly reference flights as well")
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=float, help="for each engine; what is done counts")
    parser.add_argument("--work", type=Path, default=Path("runs/paired"))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    found = study(options)
    options.out.write_text(json.dumps(found, indent=1, default=list) + "\n")


if __name__ == "__main__":
    main()
