"""Generate withheld cases: logs to one folder, answers to another.

    python -m experiments.withheld.generate --seed 11 --scale 1.0 --logs OUT/logs --answers OUT/answers.json
    [--jobs 8]

Prints the SHA-256 of the answers. `--floor` measures the noise floor again and writes floor.json beside this
file.
"""

import argparse
import gzip
import hashlib
import io
import json
import math
import multiprocessing
import os
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from experiments.withheld import cases, plan, replay, sensors  # noqa: E402

VEHICLE = """[vehicle]
name = "crazyflie-2.1"
mass = 0.03210
mass_weighed = {weighed}

[motor]
command = "thrust"
order = ["front_right", "rear_right", "rear_left", "front_left"]
spin = ["ccw", "cw", "ccw", "cw"]

[log]
source = "simulated, cause withheld"
motion_capture_rate = 100
"""


def write_case(folder, spec, flights, flown, index):
    """Write flight_{a,b,c}.csv.gz and vehicle.toml of one case; returns the number of rows of each flight."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vehicle.toml").write_text(VEHICLE.format(weighed="true" if spec["mass_weighed"] else "false"))
    formats = [f"%.{d}f" for d in sensors.DECIMALS]
    lengths = []
    for letter, bodies, ticks in zip("abc", flights.of_flight[index], flights.ticks[index], strict=True):
        ticks = min([ticks] + [int(flown["crashed"][j]) - 5 for j in bodies])
        rows = [sensors.log_rows(flown, flights.noise, j, ticks) for j in bodies]
        text = io.StringIO()
        text.write(",".join(sensors.COLUMNS) + "\n")
        line = ",".join(formats)
        for k in range(ticks):
            for vehicle, values in enumerate(rows):
                text.write(f"{0.01 * k:.2f},{vehicle}," + (line % tuple(values[k])).replace("nan", "") + "\n")
        # mtime 0: the same seed gives the same bytes
        with (
            open(folder / f"flight_{letter}.csv.gz", "wb") as raw,
            gzip.GzipFile("", "wb", 6, raw, mtime=0) as packed,
        ):
            packed.write(text.getvalue().encode())
        lengths.append(ticks)
    return lengths


def _pair_strengths(seed, specs):
    """Severity of each cause of a pair when it acts alone, written into the cause."""
    both = [(s, c) for s in specs if len(s["causes"]) > 1 for c in s["causes"]]
    if not both:
        return
    lone = cases.Flights(seed, [dict(s) for s, _ in both])
    rms = []
    for own in ([[] for _ in both], [[c] for _, c in both]):
        flown, _ = lone.fly(own)
        rms.append(lone.rms(replay.errors(flown, cases.TICKS), flown))
    reached = cases.severity(rms[1], rms[0], cases.floor()).max(axis=0)
    for (_, cause), value in zip(both, reached, strict=True):
        cause["severity_alone"] = round(float(value), 3)


def fly_chunk(job):
    """Fly, calibrate and write one list of cases; returns their answers."""
    seed, specs, folder = job
    alone = [(i, j) for i, s in enumerate(specs) for j in range(len(s["causes"]))]
    if alone:  # the causes of a pair are calibrated one by one on the same flights
        lone = cases.Flights(seed, [dict(specs[i]) for i, _ in alone])
        cases.calibrate(
            lone, [[specs[i]["causes"][j]] for i, j in alone], [specs[i]["targets"][j] for i, j in alone]
        )
    _pair_strengths(seed, specs)
    flights = cases.Flights(seed, specs)
    nominal, _ = flights.fly([[] for _ in specs])
    without = flights.rms(replay.errors(nominal, cases.TICKS), nominal)
    for attempt in range(5):
        flown, magnitudes = flights.fly([s["causes"] for s in specs])
        early = [
            i for i, c in enumerate(flights.columns) if flown["crashed"][c].min() < 700 and specs[i]["causes"]
        ]
        if not early or attempt == 4:
            break
        for i in early:
            for cause in specs[i]["causes"]:
                cause["size"] *= 0.65
    level = cases.floor()
    ratio = cases.severity(flights.rms(replay.errors(flown, cases.TICKS), flown), without, level)
    before = flights.rms(replay.errors(flown, cases.TICKS, flights.logged(flown)), flown) / level[:, None]
    after = (
        flights.rms(replay.errors(nominal, cases.TICKS, flights.logged(nominal)), nominal) / level[:, None]
    )
    answers = []
    for i, spec in enumerate(specs):
        lengths = write_case(folder / spec["name"], spec, flights, flown, i)
        gap, rest = (float(np.sqrt(np.mean(x[:, i] ** 2))) for x in (before, after))
        top = float(ratio[:, i].max())
        answers.append(
            {
                "case": spec["name"],
                "kind": spec["kind"],
                "effects": spec["effects"],
                "without": spec["without"],
                "mass_weighed": spec["mass_weighed"],
                "causes": [c | {"magnitudes": m} for c, m in zip(spec["causes"], magnitudes[i], strict=True)],
                "severity_target": spec["band"],
                "severity_ratio": round(top, 3),
                "severity": cases.label(top) if spec["causes"] else None,
                "ratio_per_channel": {
                    c: round(float(r), 3) for c, r in zip(replay.CHANNELS, ratio[:, i], strict=True)
                },
                "gap": {"before": gap, "floor": rest, "closed_by_truth": max(0.0, 1 - rest / gap)},
                "exposure": cases.exposure(flown, flights, i),
                "hidden": spec.get("hidden"),
                "flights": [list(m) for m in spec["flights"]],
                "ticks": lengths,
                "crashed": bool((flown["crashed"][flights.columns[i]] < cases.TICKS).any()),
            }
        )
    return answers


def measure_floor(seed=0, count=24):
    """Rms replay error of nominal flights from their logs, per channel; written to floor.json."""
    specs = plan.make_plan(seed, {"none": count})
    flights = cases.Flights(seed, specs)
    flown, _ = flights.fly([[] for _ in specs])
    errors = replay.errors(flown, cases.TICKS, flights.logged(flown))
    level = np.sqrt(np.mean(errors**2, axis=(1, 2)))
    text = {
        "seed": seed,
        "cases": count,
        "what": replay.__doc__.strip().splitlines()[0],
        "floor": {c: float(f"{v:.4g}") for c, v in zip(replay.CHANNELS, level, strict=True)},
    }
    cases.FLOOR_FILE.write_text(json.dumps(text, indent=2) + "\n")
    return text


def generate(seed, scale, logs, jobs=1, counts=None, chunk=None):
    """All cases of the plan; writes the logs and returns the answers, sorted by case."""
    specs = plan.make_plan(seed, counts or plan.counts(scale))
    size = chunk or max(4, min(48, math.ceil(len(specs) / jobs)))
    work = [(seed, specs[i : i + size], Path(logs)) for i in range(0, len(specs), size)]
    answers, start = [], time.perf_counter()
    if jobs == 1:
        for job in work:
            answers += fly_chunk(job)
            print(f"{len(answers)}/{len(specs)} cases, {time.perf_counter() - start:.0f} s", flush=True)
    else:
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            for part in pool.imap_unordered(fly_chunk, work):
                answers += part
                print(f"{len(answers)}/{len(specs)} cases, {time.perf_counter() - start:.0f} s", flush=True)
    return sorted(answers, key=lambda a: a["case"])


def write_answers(path, answers, seed, scale):
    """Write the answers as JSON; returns the SHA-256 of the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(
        {
            "seed": seed,
            "scale": scale,
            "bands": cases.BANDS,
            "floor": json.loads(cases.FLOOR_FILE.read_text())["floor"],
            "cases": {a["case"]: a for a in answers},
        },
        indent=1,
    )
    path.write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    path.with_suffix(".sha256").write_text(digest + "\n")
    return digest


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scale", type=float, default=1.0, help="1.0: the full plan")
    parser.add_argument(
        "--kinds",
        help="own plan instead: none=4,rotor_drag=3,pair=2,unknown=2,not_testable=1,each=1 (of every effect)",
    )
    parser.add_argument("--logs", type=Path, default=Path("withheld/logs"))
    parser.add_argument("--answers", type=Path, default=Path("withheld_answers/answers.json"))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--floor", action="store_true")
    options = parser.parse_args()
    if options.floor:
        print(json.dumps(measure_floor(), indent=2))
        return
    if options.answers.resolve().is_relative_to(options.logs.resolve()):
        parser.error("--answers must not lie inside --logs")
    counts = plan.parse_counts(options.kinds) if options.kinds else None
    options.logs.mkdir(parents=True, exist_ok=True)
    answers = generate(options.seed, options.scale, options.logs, options.jobs, counts)
    # the only thing told beside the logs: which effects the library must do without (the left-out cases)
    told = {a["case"]: a["without"] for a in answers if a["without"]}
    (options.logs / "without.json").write_text(json.dumps(told, indent=1))
    print("sha256", write_answers(options.answers, answers, options.seed, options.scale))


if __name__ == "__main__":
    main()
