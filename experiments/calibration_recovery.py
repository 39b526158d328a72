"""Does calibration recover known constants within its intervals? Simulated vehicles with drawn constants.

    python -m experiments.calibration_recovery [--cases 40] [--out
    experiments/results/calibration_recovery.json]

Each case is three flights of 8 s of a vehicle whose constants differ from the nominal ones by up to 20 %
(thrust: -10 to +15 %, torque constant: 0.3 to 1.35 times, motor lag: 0.6 to 2.2 times), mass weighed.
Settings: pose and IMU; IMU alone; drag and wind besides, which the calibration must not take for constants.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from openjax.calibration.calibration import calibrate
from openjax.commands.machine import describe_machine
from openjax.flights.checks import check_flight
from openjax.flights.flight import Case
from openjax.flights.reading import flights_of
from openjax.gap.samples import fly, log_of, references
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_file import VehicleFile

NOMINAL = load_vehicle()
AIR = {"rotor_drag": {"d_xy": 0.015, "d_z": 0.008}, "wind": {"x": 0.8, "y": -0.5, "drag": 0.015}}
SETTINGS = {"pose and IMU": {}, "IMU alone": {}, "pose and IMU, drag and wind": AIR}
QUANTITIES = ("thrust_constant", "torque_constant", "motor_time_constant", "inertia xx", "inertia yy")


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """Constants relative to nominal."""
    low = np.log([0.9, 0.3, 0.6, 0.82, 0.82])
    high = np.log([1.15, 1.35, 2.2, 1.22, 1.22])
    return dict(zip(QUANTITIES, np.exp(rng.uniform(low, high)).tolist(), strict=True))


def case_of(truth: dict[str, float], seed: int, effects, imu_only: bool) -> Case:
    plant = NOMINAL.replace(
        thrust_constant=NOMINAL.thrust_constant * truth["thrust_constant"],
        torque_constant=NOMINAL.torque_constant * truth["torque_constant"],
        motor_time_constant=NOMINAL.motor_time_constant * truth["motor_time_constant"],
        inertia=NOMINAL.inertia * jnp.array([truth["inertia xx"], truth["inertia yy"], 1.0]),
    )
    flights = []
    for number, (name, reference) in enumerate(references(seed, duration=8.0).items()):
        columns = fly(plant, NOMINAL, reference, 100 * seed + number, effects)
        (flight,), _ = flights_of(log_of(columns, name))
        checked, issues = check_flight(flight, NOMINAL)
        if checked is None:
            raise RuntimeError(f"seed {seed}: {issues}")
        if imu_only:
            checked = dataclasses.replace(checked, position=None, quaternion=None, velocity=None)
        flights.append(checked)
    return Case(f"seed {seed}", tuple(flights), VehicleFile(vehicle=NOMINAL, mass_weighed=True))


def run(setting: str, count: int) -> dict:
    rng = np.random.default_rng(0)
    errors = {q: [] for q in QUANTITIES}
    covered = {q: [] for q in QUANTITIES}
    seconds = []
    for seed in range(count):
        truth = drawn(rng)
        case = case_of(truth, seed, SETTINGS[setting], setting.startswith("IMU"))
        start = time.perf_counter()
        result = calibrate(case)
        seconds.append(time.perf_counter() - start)
        for name in QUANTITIES:
            key, _, axis = name.partition(" ")
            quantity, i = result.quantities[key], {"": 0, "xx": 0, "yy": 1}[axis]
            value = truth[name] * quantity.nominal[i]
            errors[name].append(quantity.value[i] / value - 1)
            low, high = quantity.interval90[i]
            covered[name].append(bool(quantity.determined and low <= value <= high))
    return {
        "n": count,
        "seconds_per_case": float(np.median(seconds)),
        "quantities": {
            q: {
                "median_relative_error": float(np.median(np.abs(errors[q]))),
                "bias": float(np.mean(errors[q])),
                "coverage_of_90_percent_interval": float(np.mean(covered[q])),
            }
            for q in QUANTITIES
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/calibration_recovery.json"))
    arguments = parser.parse_args()
    results = {setting: run(setting, arguments.cases) for setting in SETTINGS}
    table = Table("setting", "quantity", "median error", "bias", "coverage of 90 %")
    for setting, result in results.items():
        for name, q in result["quantities"].items():
            figures = (q["median_relative_error"], q["bias"], q["coverage_of_90_percent_interval"])
            table.add_row(setting, name, *(f"{f:.1%}" for f in figures))
    Console().print(table)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(
        json.dumps({"machine": describe_machine(), "settings": results}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
