"""An attitude that nobody logged: what gyroscope, accelerometer and path say of it is
right, whatever acts, and is no measurement of its own.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openjax.flights.checks import check_flight
from openjax.flights.pairs import Signals
from openjax.flights.reading import LogTable, flights_of
from openjax.flights.signals import clock_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()
QUATERNION = ("qw", "qx", "qy", "qz")
VELOCITY = ("vx", "vy", "vz")


def check(columns):
    table = LogTable("flight.csv", columns, np.full(len(columns["t"]), "0"))
    (flight,), _ = flights_of(table)
    return check_flight(flight, VEHICLE)


@pytest.mark.parametrize("without", [QUATERNION, (*QUATERNION, *VELOCITY)], ids=["", "velocity"])
@pytest.mark.parametrize("name", ["flight_a", "flight_b", "flight_c"])
def test_an_attitude_comes_from_gyroscope_accelerometer_and_path(name, without, sample_columns):
    columns = sample_columns[name]
    kept, issues = check({n: v for n, v in columns.items() if n not in without})
    assert kept.attitude_derived and any("attitude" in i.issue for i in issues)
    logged = np.stack([columns[n] for n in QUATERNION], 1)
    true, found = (Rotation.from_quat(q, scalar_first=True) for q in (logged, kept.quaternion))
    off = np.degrees((found * true.inv()).as_rotvec())
    # An accelerometer's bias of 1 % of gravity is half a degree.
    assert np.sqrt((off**2).mean(0)).max() < 4.0
    assert Signals.of(kept, clock_of(kept)).quaternion is None


def test_a_gyroscope_with_a_bias_and_another_gain_turns_it_no_further(sample_columns):
    columns = dict(sample_columns["flight_b"])
    logged = np.stack([columns[n] for n in QUATERNION], 1)
    for axis in ("wx", "wy", "wz"):
        columns[axis] = 1.05 * columns[axis] + 0.02
    kept, _ = check({n: v for n, v in columns.items() if n not in QUATERNION})
    true, found = (Rotation.from_quat(q, scalar_first=True) for q in (logged, kept.quaternion))
    assert np.degrees((found * true.inv()).magnitude()).mean() < 3.0


@pytest.mark.parametrize("missing", [("ax",), ("x", *VELOCITY), ("wx",)])
def test_what_tells_no_attitude_makes_none(missing, sample_columns):
    columns = sample_columns["flight_b"]
    kept, _ = check({n: v for n, v in columns.items() if n not in (*QUATERNION, *missing)})
    assert kept is None or (kept.quaternion is None and not kept.attitude_derived)
