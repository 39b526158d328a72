"""What an identification of torques makes of flights with known truth: rows of 100, 250 and 500 Hz,
means and samples, motors logged in time and late, calm air and strong gusts; and of folders of real
flights, where only the simulator's numbers stand beside.

    python -m experiments.diagnosis.identification --out experiments/results/identification.json
"""

import argparse
import dataclasses
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.diagnosis.rate_flights import TICK, Truth, fly, rows_of, vehicle_of
from openjax.flights.case import load_case
from openjax.flights.track import Track
from openjax.gap.identification.prediction_errors import NAMES, Problem
from openjax.gap.identification.quantities import identify
from openjax.gap.identification.responses import responses
from openjax.gap.identification.search import TorqueFit, begin, search
from openjax.gap.identification.torques import identify_torques
from openjax.vehicle import load_vehicle

SECONDS = 20.0
SEEDS = 3
GUSTS = (3.0, 8.0, 15.0)  # rad/s^2
BRUSHED = {
    "brushed, 60 ms": Truth(up=0.06, down=0.078, delay=0.004, damping=1.0),
    "brushed, 75 ms": Truth(up=0.075, down=0.075, delay=0.004, damping=1.0),
    "brushed, 90 ms": Truth(up=0.09, down=0.11, delay=0.004, damping=1.0, inertia=1.2),
}
"""Motors as rotor speed sensors measured them on small vehicles."""
VEHICLES = BRUSHED | {
    "nominal": Truth(),
    "slower down": Truth(up=0.03, down=0.045),
    "inertia": Truth(inertia=1.3),
    "damped": Truth(damping=4.0),
}


class Rows(NamedTuple):
    """How a flight is logged: rate, Hz; whether motors are samples; whether what is new in a row
    may act on its end; of how many flights; s by which motors are logged late.
    """

    rate: int
    samples: bool = False
    free: bool = True
    seeds: int = SEEDS
    late: float = 0.0


ROWS = {
    "100 Hz means": Rows(100),
    "100 Hz means, direct": Rows(100, free=False),
    "100 Hz samples": Rows(100, samples=True),
    "250 Hz means": Rows(250, seeds=1),
    "500 Hz": Rows(500, seeds=1),
    "100 Hz means, 4 ms late": Rows(100, late=0.004),
    "100 Hz means, 6 ms late": Rows(100, late=0.006),
    "100 Hz means, 8 ms late": Rows(100, late=0.008),
}
TOLD = NAMES[:8]


def record_of(rates, motor, rate: int, samples: bool, vehicle) -> Track:
    """A track of rows without anything but rates and motors."""
    time = np.arange(len(rates)) / rate
    return Track(
        "flight", "flight", 1.0 / rate, time, rates, motor=motor, vehicle=vehicle, samples=samples
    )


def fitted(record: Track, free: bool) -> TorqueFit:
    """The fit; not `free`: as if rows hid nothing."""
    if free:
        return identify_torques([record])
    problem = Problem([record])
    problem.new = [None]
    return search(problem, begin(problem, 0.002))


def truth_of(truth: Truth) -> np.ndarray:
    """(8,) the parameters of TOLD."""
    gain = 1.0 / truth.inertia
    return np.array(
        [truth.up, truth.down, truth.delay, gain, gain, gain * truth.yaw, *[truth.damping] * 2]
    )


def flown() -> tuple[list[tuple], tuple]:
    """(vehicle, gusts, number) of each flight, and all flights' gyroscopes and motors."""
    cases = list(itertools.product(VEHICLES, GUSTS, range(SEEDS)))
    # Each flight has air of its own, so that their errors are independent.
    truths = [
        dataclasses.replace(VEHICLES[name], gust=gust, seed=place)
        for place, (name, gust, _) in enumerate(cases)
    ]
    return cases, fly(truths, SECONDS)


def logged(seen, motors, rows: Rows, vehicle) -> Track:
    """The record of a flight whose every cycle is known, as rows tell it."""
    cycles = round(rows.late / TICK)
    motors = np.roll(motors, cycles, axis=0)
    return record_of(
        *rows_of(seen[cycles:], motors[cycles:], rows.rate, rows.samples),
        rows.rate,
        rows.samples,
        vehicle,
    )


def study(kinds: list[str]) -> list[dict]:
    """One row for each of these kinds of rows, vehicle and strength of gusts."""
    nominal = vehicle_of(load_vehicle())
    cases, flights = flown()
    out = []
    for kind in kinds:
        rows = ROWS[kind]
        for name, gust in itertools.product(VEHICLES, GUSTS):
            records = [
                logged(seen, motors, rows, nominal)
                for case, seen, motors in zip(cases, *flights, strict=True)
                if case[:2] == (name, gust) and case[2] < rows.seeds
            ]
            fits = [fitted(record, rows.free) for record in records]
            right = truth_of(VEHICLES[name])
            right[2] -= rows.late
            out.append({"rows": kind, "vehicle": name, "gust": gust} | told(fits, right))
            if rows.free:
                pairs = [responses([r], f)["roll"] for r, f in zip(records, fits, strict=True)]
                points = [[p.measured.at(f) for f in (2.0, 5.0, 10.0)] for p in pairs]
                out[-1]["roll_at_2_5_10_hz"] = np.mean(points, 0).round(1).tolist()
            print(kind, name, gust, out[-1]["mean"], flush=True)
    return out


def told(fits: list[TorqueFit], right: np.ndarray) -> dict:
    """The mean of several fits beside what is right (8,), and how often their intervals hold it."""
    values = np.array([f.value[:8] for f in fits])
    deviations = np.array([np.sqrt(np.diag(f.covariance))[:8] for f in fits])
    inside = np.abs(values - right) < 1.645 * deviations
    return {
        "flights": len(fits),
        "truth": dict(zip(TOLD, right.tolist(), strict=True)),
        "mean": dict(zip(TOLD, values.mean(0).round(5).tolist(), strict=True)),
        "inside_90": dict(zip(TOLD, inside.mean(0).tolist(), strict=True)),
    }


def summary(rows: list[dict]) -> dict:
    """Of each kind of rows: root mean squares of the logarithms of lag and gain over the truth, and
    how often 90 % intervals hold it.
    """
    found = {}
    for kind in dict.fromkeys(r["rows"] for r in rows):
        of = [r for r in rows if r["rows"] == kind]

        def off(name, of=of):
            logs = [np.log(r["mean"][name] / r["truth"][name]) for r in of]
            return round(float(np.sqrt(np.mean(np.square(logs)))), 4)

        found[kind] = {
            "lag": off("spin_up"),
            "gain": off("roll_gain"),
            "damping": round(
                float(
                    np.sqrt(
                        np.mean([(r["mean"]["damping"] - r["truth"]["damping"]) ** 2 for r in of])
                    )
                ),
                3,
            ),
            "inside_90": _inside(of),
            "inside_90_brushed": _inside([r for r in of if r["vehicle"] in BRUSHED]),
        }
    return found


def _inside(rows: list[dict]) -> float:
    """How often 90 % intervals of any number hold the truth."""
    return round(float(np.mean([list(r["inside_90"].values()) for r in rows])), 3)


def of_flights(folder: Path) -> dict:
    """What a case's flights say, and the share of the simulator's response that they show."""
    found = identify(load_case(folder))
    shares = {f"{f:g} Hz": [round(v, 3) for v in found.at(f)] for f in (2.0, 5.0, 10.0)}
    quantities = {
        name: [round(v, 5) for v in (q.value, *q.interval90, q.simulator)]
        for name, q in found.quantities.items()
    }
    return {
        "gain_share_and_phase_beyond_the_simulators": shares,
        "value_low_high_simulator": quantities,
        "remarks": list(found.remarks),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("identification.json"))
    parser.add_argument("--flights", type=Path, nargs="*", default=[])
    parser.add_argument(
        "--rows", nargs="*", choices=list(ROWS), default=list(ROWS), help="others stay as they are"
    )
    arguments = parser.parse_args()
    out = arguments.out
    before = json.loads(out.read_text()) if out.exists() else {"flights": {}, "rows": []}
    real = {folder.name: of_flights(folder) for folder in arguments.flights}
    rows = [r for r in before["rows"] if r["rows"] not in arguments.rows]
    rows += study(arguments.rows)
    flights = before["flights"] | real
    command = "python -m experiments.diagnosis.identification"
    command += "".join(f" --flights {name}" for name in flights) + f" --out {out.name}"
    found = {"command": command, "summary": summary(rows), "flights": flights, "rows": rows}
    text = json.dumps(found, indent=1)
    out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
