"""The exam from end to end: cases are drawn and flown, their answers sealed, the logs diagnosed,
the answers opened.

    python -m experiments.diagnosis.run --columns stranger=120 rotorpy=2 --seed 1201 --cores 24
    --work DIR --out PAGE

A column is `known`, `real` or `stranger` with a number of cases, or `rotorpy` with a number of
cases of each kind. `--sets DIR[=ANSWERS]` takes folders of cases that are there already. The digest
of the answers is written before the first diagnosis. A column whose answers lie in the work folder
isn't flown again, and cases that are diagnosed aren't again. `--report` makes the page anew from
what is stored. Seeds below 1000 are for development; each other seed is answered once.
"""

import math
import os
import subprocess
import sys
import time
from pathlib import Path

from experiments.diagnosis import development, figures
from experiments.table import Page, page_parser, publish

LEFT_OUT = (
    "parameters quality gap probabilities not_testable rest false_unknown right_names".split()
)
ROOT = Path(__file__).resolve().parents[2]


def fly(column: str, count: int, options) -> str:
    """Fly a column in a process of its own, which sees nothing of the diagnosis; the SHA-256 of its
    answers.
    """
    work = options.work.resolve()
    logs = work / column
    answers = work / f"{column}_answers.json"
    if not answers.exists():
        module, number = (
            ("rotorpy_cases", "--each") if column == "rotorpy" else ("generate", "--count")
        )
        command = [sys.executable, "-m", f"experiments.diagnosis.{module}", number, str(count)]
        command += [] if column == "rotorpy" else ["--column", column]
        command += ["--seed", str(options.seed), "--logs", str(logs), "--answers", str(answers)]
        subprocess.run([*command, "--jobs", str(options.cores)], cwd=ROOT, check=True)
    return answers.with_suffix(".sha256").read_text().strip()


def study(options) -> dict:
    """Fly, diagnose and judge all columns."""
    begin = time.perf_counter()
    wanted = dict(entry.split("=") for entry in options.columns)
    digests = {column: fly(column, int(count), options) for column, count in wanted.items()}
    out = options.work / "cases.jsonl"
    sets = [str(options.work / column) for column in wanted] + options.sets
    arguments = ["--sets", *sets, "--cores", str(options.cores), "--out", str(out)]
    if options.seconds:
        arguments += ["--seconds", str(options.seconds - (time.perf_counter() - begin))]
    development.main(arguments)
    lines = [
        {k: v for k, v in line.items() if k not in LEFT_OUT}
        for line in development.read_lines([out])
    ]
    columns = {}
    for name in sorted({x["set"] for x in lines}):
        columns[name] = {"figures": stored_figures([x for x in lines if x["set"] == name])}
    found = {"seed": options.seed, "note": options.note, "answers_sha256": digests}
    return found | {"columns": columns, "cases": lines}


def stored_figures(lines: list[dict]) -> dict[str, dict]:
    """Figure -> {"hits", "n", "value"}, or its value alone; what no case tells is left out."""
    out = {}
    for name, found in figures.figures(lines).items():
        hits, n = found if isinstance(found, tuple) else (None, None)
        if n is None and math.isfinite(found):
            out[name] = {"value": found}
        elif n:
            out[name] = {"hits": hits, "n": n, "value": hits / n}
    return out


def page(results: dict) -> Page:
    """The figures of each column, then where they miss."""
    digests = ", ".join(f"{c} {d[:16]}" for c, d in results["answers_sha256"].items())
    prose = (
        "Cases are flown, their answers sealed, the logs diagnosed, the answers opened, once. In "
        f"brackets: 95 % interval. Seed {results['seed']}; SHA-256 of the answers: "
        f"{digests or 'given'}. {results['note']}"
    )
    table, misses = (
        "\n".join(part(results["cases"])) for part in (figures.figures_table, figures.misses)
    )
    misses += results.get("history", "")
    parts = [table, f"## Misses\n\n{misses}"]
    return Page("The exam of the diagnosis", prose, parts, figures.shown(results["cases"]))


def main() -> None:
    """Run or report."""
    parser = page_parser(__doc__, "exam")
    parser.add_argument("--columns", nargs="+", default=[], metavar="COLUMN=CASES")
    parser.add_argument("--sets", nargs="+", default=[], metavar="DIR[=ANSWERS]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--note", default="", help="a sentence for the page")
    parser.add_argument("--seconds", type=float, help="for all; what is done by then counts")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/exam"), help="logs, answers; not committed"
    )
    publish(parser.parse_args(), study, page)


if __name__ == "__main__":
    main()
