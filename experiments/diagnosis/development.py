"""Diagnose sets of cases with known answers, in parallel processes: one JSON line a case, and one
table.

    python -m experiments.diagnosis.development --sets DIR DIR=ANSWERS.json … --out cases.jsonl
    python -m experiments.diagnosis.development --report cases.jsonl …

A set is a folder of cases (folders of logs with a vehicle.toml); its answers lie in
DIR/answers.json, in DIR_answers.json beside it or are named. Lines are written as cases end, so
that a run which is cut short still counts; cases in the file already aren't done again.
`--engine-options` is a JSON object handed to `openjax.gap.diagnosis.diagnose_case`.
"""

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from experiments.diagnosis import truth
from experiments.diagnosis.figures import figures_table, misses
from experiments.diagnosis.healthy import healthy_beside
from experiments.diagnosis.magnitudes import parameters
from experiments.flying.single_thread import use_single_thread

UNTOLD = {"category": "real", "effects": []}
_done = 0  # cases that this process has diagnosed


def answers_of(folder: Path) -> Path | None:
    """Where the answers of a set lie, if there are any."""
    places = (folder / "answers.json", folder.with_name(folder.name + "_answers.json"))
    return next((p for p in places if p.exists()), None)


def find_jobs(sets: list[str], options: dict) -> list[tuple]:
    """(set, folder, answer, options) of every case, sets interleaved in a fixed random order."""
    jobs = []
    for entry in sets:
        place, _, named = entry.partition("=")
        answers = Path(named) if named else answers_of(Path(place))
        told = truth.read_answers(answers) if answers else {}
        for case in sorted(p.parent for p in Path(place).glob("*/vehicle.toml")):
            jobs.append((Path(place).name, case, told.get(case.name, UNTOLD), options))
    return [jobs[i] for i in np.random.default_rng(0).permutation(len(jobs))]


def diagnose(job: tuple) -> dict:
    """The line of one case."""
    global _done
    place, folder, answer, options = job
    options = dict(options)
    healthy = options.pop("healthy", False)
    true = truth.truth_of(answer)
    start = time.perf_counter()
    report = None
    error = None
    trace = None
    broken = []
    try:
        from openjax.errors import UserError
        from openjax.flights.case import load_case
        from openjax.gap.diagnosis import diagnose_case
        from openjax.gap.report.rules import broken_rules

        try:
            if healthy:
                options["reference"] = [load_case(healthy_beside(folder.parent) / folder.name)]
            made = diagnose_case(load_case(folder), **options)
            report = made.to_dict()
            broken = broken_rules(made)
        except UserError as refusal:
            # a case, not a place of this machine
            error = str(refusal).replace(f"{folder.parent}/", "")[:500]
    except Exception:  # a traceback is a finding, not the end
        trace = traceback.format_exc()[-2000:]
    seconds = round(time.perf_counter() - start, 2)
    _done = _done + 1
    words = truth.words_of(report)
    line = {"set": place, "case": folder.name, "category": true.category, "truth": true.effects}
    line |= {"words": words} | truth.judge(true, words)
    right = truth.right_names(true)
    line |= {"right_names": sorted(right)}
    line |= {"top": truth.top_probability(right, (report or {}).get("probabilities", {}))}
    line |= {"severity": answer.get("severity"), "magnitudes": parameters(answer, report)}
    line |= {"broken_rules": broken}
    line |= {"seconds": seconds, "first": _done == 1, "error": error, "traceback": trace}
    fields = ("probabilities", "shares", "parameters", "gap", "not_testable", "rest", "quality")
    fields += ("residual", "residual_before")
    return line | {k: report[k] for k in fields if report and k in report}


def run(jobs: list[tuple], cores: int, out: Path, seconds: float | None) -> None:
    """Diagnose the `jobs` and append a line each to `out`."""
    use_single_thread()  # before a worker imports JAX
    start = time.perf_counter()
    pool = multiprocessing.get_context("spawn").Pool(min(cores, len(jobs)))
    with pool, out.open("a") as file:
        results = pool.imap_unordered(diagnose, jobs)
        for number in range(1, len(jobs) + 1):
            left = None if seconds is None else max(seconds - (time.perf_counter() - start), 0.01)
            try:
                line = results.next(timeout=left)
            except multiprocessing.TimeoutError:
                print(
                    f"time is up after {seconds:.0f} s, {len(jobs) - number + 1} left",
                    file=sys.stderr,
                )
                return
            file.write(json.dumps(line, default=list) + "\n")
            file.flush()
            said = "+".join(line["words"]) or "none"
            print(f"{number}/{len(jobs)} {line['set']}/{line['case']} {said} {line['seconds']:.1f} s",
                  file=sys.stderr, flush=True)  # fmt: skip


def read_lines(paths: list[Path]) -> list[dict]:
    """The lines of several files."""
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def main(arguments: list[str] | None = None) -> None:
    """Run and report, or only report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", nargs="+", default=[], metavar="DIR[=ANSWERS]")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("cases.jsonl"))
    parser.add_argument("--engine-options", type=json.loads, default={}, metavar="JSON")
    parser.add_argument("--seconds", type=float, help="stop then; what is done counts")
    parser.add_argument("--report", nargs="+", type=Path, default=[], help="tables of stored lines")
    parser.add_argument("--healthy", action="store_true", help="use DIR_healthy as references")
    options = parser.parse_args(arguments)
    if options.sets:
        done = (
            {(r["set"], r["case"]) for r in read_lines([options.out])}
            if options.out.exists()
            else ()
        )
        jobs = find_jobs(options.sets, options.engine_options | {"healthy": options.healthy})
        jobs = [job for job in jobs if (job[0], job[1].name) not in done]
        if jobs:
            run(jobs, options.cores, options.out, options.seconds)
    lines = read_lines(options.report or [options.out])
    print("\n".join([*figures_table(lines), "", *misses(lines)]))


if __name__ == "__main__":
    main()
