"""Make cases of the exam: logs into one folder, answers into another file.

    python -m experiments.diagnosis.generate --seed 1 --count 60 --logs OUT/logs --answers
    OUT/answers.json [--jobs 8] [--column stranger] [--only single,none]
    [--healthy]

Prints the SHA-256 of the answers. In one pass a case is flown with four sizes of its cause; the one
whose gap, by the plant's own measure, comes nearest to the severity drawn is kept.
"""

import argparse
import hashlib
import json
import math
import multiprocessing
import time
from pathlib import Path

import numpy as np

from experiments.diagnosis import answer_key, cases, effects, measure, unknowns
from experiments.diagnosis.fleet import Fleet, bodies, write_case
from experiments.diagnosis.healthy import write_healthy
from experiments.flying.single_thread import use_single_thread

SIZES = 4
CHUNK = 8  # cases that a process flies at once


def _variants(spec):
    """The sets of causes that a case is flown with: {key: causes}."""
    if not spec["causes"]:
        return {"final": []}
    out = {"nominal": []} if spec["category"] == "unknown" else {}
    for i, cause in enumerate(spec["causes"]):
        low, high = (unknowns.SITES | effects.EFFECTS)[cause["effect"]].sizes
        for n in range(SIZES):
            place = (n + cause["shape"][7]) / SIZES
            out[i, n] = [cause | {"size": float(low * (high / low) ** place)}]
    return out


def fly_chunk(job):
    """Fly, choose and write a list of cases; returns their answers."""
    seed, column, specs, folder, healthy = job
    if healthy:
        write_healthy(seed, column, specs, folder)
    drawn = {s["name"]: bodies(seed, column, s) for s in specs}
    tried = [(s, key, own) for s in specs for key, own in _variants(s).items()]
    first = Fleet(seed, column, [(s, own) for s, _, own in tried], drawn)
    energies = first.energies()
    nominal = energies["nominal"]
    truth = energies["truth"]
    place = {(s["name"], key): i for i, (s, key, _) in enumerate(tried)}
    floors = {}
    again = []
    chosen = {}
    for spec in specs:
        name = spec["name"]
        keys = [key for s, key, _ in tried if s is spec]
        base = place[name, keys[0]]
        floors[name] = floor = answer_key.floors(first, base, truth[:, base])
        if "final" in keys:
            chosen[name] = place[name, "final"]
            continue
        for i, cause in enumerate(spec["causes"]):
            options = []
            for n in range(SIZES):
                at = place[name, (i, n)]
                after = (
                    nominal[:, place[name, "nominal"]]
                    if spec["category"] == "unknown"
                    else truth[:, at]
                )
                shown = np.sqrt(np.maximum(nominal[:, at] - after, 0.0)) / floor
                severity = max(float(shown.max()), 1e-3)
                if (
                    cause["effect"] in unknowns.SENSOR_SITES
                ):  # the motion shows nothing: a middle size
                    severity = spec["targets"][i] * (1 + abs(n - 1.5))
                crash = 10 * (first.lasts(at) < 0.7)
                if spec["category"] == "not_testable":  # as large as stays hidden
                    options.append(
                        (crash + max(math.log(severity / answer_key.HIDDEN), 0.0), -n, severity)
                    )
                else:
                    options.append(
                        (crash + abs(math.log(severity / spec["targets"][i])), n, severity)
                    )
            _, n, severity = min(options)
            n = abs(n)
            cause |= {"size": tried[place[name, (i, n)]][2][0]["size"], "alone": round(severity, 3)}
            chosen[name] = place[name, (i, n)]
            if first.lasts(chosen[name]) < 0.7:  # every size crashes: less of it
                cause["size"] *= 0.3
                again.append(spec)
        if len(spec["causes"]) > 1 and spec not in again:
            again.append(spec)
    second = Fleet(seed, column, [(s, s["causes"]) for s in again], drawn) if again else None
    energies_again = second.energies() if again else None
    answers = []
    for spec in specs:
        if spec in again:
            fleet = second
            i = again.index(spec)
            squares = energies_again
        else:
            fleet = first
            i = chosen[spec["name"]]
            squares = energies
        squares = {k: x[:, i] for k, x in squares.items()}
        # no model holds it: the same flights without it
        if spec["category"] == "unknown":
            squares["truth"] = np.minimum(
                squares["nominal"], nominal[:, place[spec["name"], "nominal"]]
            )
        wrong = write_case(fleet, i, Path(folder) / spec["name"], spoiled=True)
        answers.append(answer_key.answer_of(fleet, i, squares, floors[spec["name"]], wrong))
    return answers


def in_processes(do, work, jobs):
    """`do` of each piece of work by so many processes, as they come; one is this one."""
    if jobs == 1:
        yield from map(do, work)
    else:
        with multiprocessing.get_context("spawn").Pool(min(jobs, len(work))) as pool:
            yield from pool.imap_unordered(do, work)


def generate(seed, column, count, logs, jobs=1, only=None, healthy=False):
    """All cases, and their reference flights if they are to be `healthy`; writes the logs and
    returns the answers, sorted by case.
    """
    specs = cases.draw_cases(seed, column, count, only)
    size = max(1, min(CHUNK, math.ceil(len(specs) / jobs)))
    work = [
        (seed, column, specs[i : i + size], Path(logs), healthy) for i in range(0, len(specs), size)
    ]
    answers = []
    start = time.perf_counter()
    for part in in_processes(fly_chunk, work, jobs):
        answers += part
        print(f"{len(answers)}/{len(specs)} cases, {time.perf_counter() - start:.0f} s", flush=True)
    return sorted(answers, key=lambda a: a["case"])


def write_answers(path, answers, seed, column):
    """Write the answers as JSON; returns the SHA-256 of the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"seed": seed, "count": len(answers), "column": column, "channels": measure.CHANNELS}
    text = json.dumps(about | {"cases": {a["case"]: a for a in answers}}, indent=1)
    path.write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    path.with_suffix(".sha256").write_text(digest + "\n")
    return digest


def case_parser(doc):
    """A parser of what all that fly cases are told: which, and where to."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    return parser


def main():
    parser = case_parser(__doc__)
    parser.add_argument("--column", choices=list(cases.COLUMN), default="known")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--healthy", action="store_true", help="also LOGS_healthy: references")
    parser.add_argument("--only", help="categories, comma-separated: " + ", ".join(cases.SHARES))
    options = parser.parse_args()
    use_single_thread()
    if options.answers.resolve().is_relative_to(options.logs.resolve()):
        parser.error("--answers must not lie inside --logs")
    only = options.only.split(",") if options.only else None
    answers = generate(
        options.seed,
        options.column,
        options.count,
        options.logs,
        options.jobs,
        only,
        options.healthy,
    )
    print("sha256", write_answers(options.answers, answers, options.seed, options.column))


if __name__ == "__main__":
    main()
