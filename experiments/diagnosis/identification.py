"""What an identification of torques makes of flights with known truth: rows of 100, 250
and 500 Hz, means and samples, calm air and strong gusts; and of folders of real
flights, where only the simulator's numbers stand beside.

    python -m experiments.diagnosis.identification --out experiments/results/identification.json
"""

import argparse
import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np

from experiments.diagnosis.rate_flights import Truth, fly, rows_of, vehicle_of
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
ROWS = {
    "100 Hz means": (100, False, True, SEEDS),
    "100 Hz means, direct": (100, False, False, SEEDS),
    "100 Hz samples": (100, True, True, SEEDS),
    "250 Hz means": (250, False, True, 1),
    "500 Hz": (500, False, True, 1),
}
"""Rate, whether samples, whether what is new in a row may act on its end, seeds."""
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
    """(vehicle, gusts, number) of each flight, and all flights' gyroscopes and
    motors.
    """
    cases = list(itertools.product(VEHICLES, GUSTS, range(SEEDS)))
    # Each flight has air of its own, so that their errors are independent.
    truths = [
        dataclasses.replace(VEHICLES[name], gust=gust, seed=place)
        for place, (name, gust, _) in enumerate(cases)
    ]
    return cases, fly(truths, SECONDS)


def study() -> list[dict]:
    """One row for each kind of rows, vehicle and strength of gusts."""
    nominal = vehicle_of(load_vehicle())
    cases, flights = flown()
    out = []
    for kind, (rate, samples, free, seeds) in ROWS.items():
        for name, gust in itertools.product(VEHICLES, GUSTS):
            values = []
            deviations = []
            gains = []
            for case, seen, motors in zip(cases, *flights, strict=True):
                if case[:2] != (name, gust) or case[2] >= seeds:
                    continue
                rates, motor = rows_of(seen, motors, rate, samples)
                record = record_of(rates, motor, rate, samples, nominal)
                fit = fitted(record, free)
                values.append(fit.value[:8])
                deviations.append(np.sqrt(np.diag(fit.covariance))[:8])
                if free:
                    pair = responses([record], fit)["roll"]
                    gains.append([list(pair.measured.at(f)) for f in (2.0, 5.0, 10.0)])
            right = truth_of(truth := dataclasses.replace(VEHICLES[name], gust=gust))
            inside = np.abs(np.array(values) - right) < 1.645 * np.array(deviations)
            out.append(
                {
                    "rows": kind,
                    "vehicle": name,
                    "gust": truth.gust,
                    "flights": len(values),
                    "truth": dict(zip(TOLD, right.tolist(), strict=True)),
                    "mean": dict(zip(TOLD, np.mean(values, 0).round(5).tolist(), strict=True)),
                    "inside_90": dict(zip(TOLD, inside.mean(0).tolist(), strict=True)),
                    "roll_at_2_5_10_hz": np.mean(gains, 0).round(1).tolist() if gains else None,
                }
            )
            print(kind, name, gust, out[-1]["mean"], flush=True)
    return out


def summary(rows: list[dict]) -> dict:
    """Of each kind of rows: root mean squares of the logarithms of lag and gain over
    the truth, and how often 90 % intervals hold it.
    """
    found = {}
    for kind in ROWS:
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
    """What a case's flights say, and the share of the simulator's response that they
    show.
    """
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
    arguments = parser.parse_args()
    real = {folder.name: of_flights(folder) for folder in arguments.flights}
    rows = study()
    command = "python -m experiments.diagnosis.identification"
    command += "".join(f" --flights {name}" for name in real) + f" --out {arguments.out.name}"
    found = {"command": command, "summary": summary(rows), "flights": real, "rows": rows}
    text = json.dumps(found, indent=1)
    arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
