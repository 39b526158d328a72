"""Identification: truths of flights whose plant isn't openjax are within its
intervals.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from experiments.diagnosis import rate_flights
from experiments.diagnosis.rate_flights import Truth, fly, rows_of, vehicle_of
from openjax.flights.clocks import case_on_gyroscope_clock
from openjax.flights.flight import Case, Flight
from openjax.flights.grid import own_tracks
from openjax.flights.kinematics import Kinematics
from openjax.flights.track import Track
from openjax.gap import evidence
from openjax.gap.identification.corrections import corrections
from openjax.gap.identification.estimates import of_fit
from openjax.gap.identification.prediction_errors import NAMES
from openjax.gap.identification.quantities import Identification, doubts, quantities_of
from openjax.gap.identification.responses import responses
from openjax.gap.identification.rotor_rows import rotor_rows
from openjax.gap.identification.torque_causes import torques_of
from openjax.gap.identification.torques import identify_torques
from openjax.gap.model.library import ABSENT
from openjax.gap.report.response import pictures_of
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_file import load_vehicle_file

TRUTHS = {
    "nominal": Truth(gust=8.0),
    "slow motors": Truth(up=0.075, down=0.075, delay=0.004, gust=8.0),
    "inertia": Truth(inertia=1.3, gust=8.0),
    "damped": Truth(damping=4.0, gust=8.0),
}


def record_of(name, seen, motors, rate) -> Track:
    """A flight as rows of so many Hz, with motors as means."""
    rates, motor = rows_of(seen, motors, rate, samples=False)
    return Track(
        name=name,
        flight=name,
        dt=1.0 / rate,
        time=np.arange(len(rates)) / rate,
        body_rates=rates,
        motor=motor,
        vehicle=vehicle_of(load_vehicle()),
    )


@pytest.fixture(scope="module")
def records():
    flights = zip(TRUTHS, *fly(list(TRUTHS.values()), 20.0), strict=True)
    return {name: record_of(name, *flight, 100) for name, *flight in flights}


@pytest.mark.parametrize("name", TRUTHS)
def test_truth_lies_within_three_deviations_in_gusts(records, name):
    truth = TRUTHS[name]
    fit = identify_torques([records[name]])
    gain = 1.0 / truth.inertia
    right = [truth.up, truth.down, truth.delay, gain, gain, gain, truth.damping, truth.damping, 0.0]
    off = (fit.value - right) / np.sqrt(np.diag(fit.covariance))
    assert np.abs(off[:-1]).max() < 3.0, dict(zip(NAMES, off, strict=True))


def test_slow_motors_are_lag_and_not_inertia(records):
    record = records["slow motors"]
    found = of_fit(identify_torques([record]), record.vehicle)
    lag, lag_error = found.of("motor_lag", "extra_up")
    inertia, inertia_error = found.of("inertia", "xx")
    assert abs(lag - 0.05) < 3.0 * lag_error < 0.045
    assert abs(inertia - 1.0) < 3.0 * inertia_error < 0.4


def test_slow_motors_are_named_and_nothing_beside(records):
    named = {}
    for name in ("nominal", "slow motors", "inertia"):
        record = records[name]
        estimates = of_fit(identify_torques([record]), record.vehicle)
        found = SimpleNamespace(estimates=estimates, trustworthy=True)
        named[name] = torques_of(found, None, record.vehicle, False, ABSENT).names
    assert named == {"nominal": (), "slow motors": ("motor_lag",), "inertia": ("inertia",)}


def test_motors_logged_late_are_a_clock(records):
    record = records["nominal"]
    rows = 4
    late = replace(record.rows(slice(rows, None)), motor=record.motor[: len(record) - rows])
    fit = identify_torques([late])
    assert abs(fit.clock + rows * record.dt) < 0.005
    assert abs(fit.value[0] - 0.025) < 0.006


def test_the_first_sentence_and_the_training_know_slow_motors(records):
    record = records["slow motors"]
    fit = identify_torques([record])
    found = Identification(
        quantities_of([record], fit), responses([record], fit), (), of_fit(fit, record.vehicle)
    )
    values, intervals = corrections(found, effects=())
    assert set(values) == {"motor_lag"}
    low, high = intervals["motor_lag"]["extra_up"]
    assert low < 0.05 < high
    assert "later." in found.sentence()
    assert found.in_words("motor_lag").startswith("time constant of speeding up 7")
    assert (low + 0.025, high + 0.025) == pytest.approx(found.quantities["spin_up"].interval90)
    unmapped = replace(found, duty_cycles=True)
    assert set(corrections(unmapped, effects=("inertia", "motor_lag"))[0]) == {"motor_lag"}
    # what an emptier battery does to the gains isn't flown with twice
    gains = np.array([1.0, 1.0, 1.0, 0.6, 0.6, 1.0, 1.0, 1.0, 1.0])
    other = replace(fit, value=gains * fit.value)
    numbers = quantities_of([record], other)
    weaker = replace(found, quantities=numbers, estimates=of_fit(other, record.vehicle))
    assert "inertia" in corrections(weaker, effects=())[0]
    assert "inertia" not in corrections(weaker, effects=("battery_sag",))[0]
    # yaw tells a torque over an inertia, which isn't flown with twice
    slow_yaw = replace(fit, value=np.where(np.arange(9) == 5, 0.6, 1.0) * fit.value)
    numbers = quantities_of([record], slow_yaw)
    turning = replace(found, quantities=numbers, estimates=of_fit(slow_yaw, record.vehicle))
    assert "yaw_torque" in corrections(turning, effects=())[0]
    assert "yaw_torque" not in corrections(turning, effects=("inertia",))[0]
    # A lag of 75 instead of 25 ms and 4 ms of delay, at 5 Hz.
    ratio = (1 + 2j * np.pi * 5.0 * 0.025) / (1 + 2j * np.pi * 5.0 * 0.075)
    gain, later = found.at(5.0)
    assert gain == pytest.approx(abs(ratio), rel=0.15)
    assert later == pytest.approx(np.rad2deg(np.angle(ratio)) - 360.0 * 5.0 * 0.004, abs=8.0)
    assert [axis for axis, _ in pictures_of(found)] == ["roll", "pitch", "yaw"]
    assert found.to_dict({"motor_lag": 0.5})["quantities"]["spin_up"]["share_of_gap"] == 0.5


def test_rotors_in_lanes_turn_as_one_long_flight():
    rng = np.random.default_rng(0)
    commands = np.clip(0.5 + 0.2 * rng.standard_normal((700, 4)), 0.0, 1.0)
    up, down, late, dt, fine = 0.03, 0.06, 0.004, 0.01, 50
    (square, speed), _ = rotor_rows([commands, commands[:7]], dt, np.array([[up, down, late]]))
    target = np.repeat(np.sqrt(commands), fine, 0)
    target = np.concatenate([target[:1].repeat(round(late / dt * fine), 0), target])
    now = target[0]
    squares = np.zeros_like(commands)
    ends = np.zeros_like(commands)
    for step in range(len(commands) * fine):
        after = target[step] + (now - target[step]) * np.exp(
            -dt / fine / np.where(target[step] < now, down, up)
        )
        squares[step // fine] += 0.5 * (now**2 + after**2) / fine
        now = ends[step // fine] = after
    assert np.allclose(speed[0], ends, atol=2e-4)
    assert np.allclose(square[0], squares, atol=2e-4)


def test_the_filter_of_the_gyroscope_is_no_delay_of_the_motors():
    truth = Truth(up=0.05, down=0.07, delay=0.004)
    (seen,), (motors,) = fly([truth], 4.0)
    low = butter(2, 80.0, fs=500.0)
    for rates in (seen, lfilter(*low, seen, axis=0)):
        fit = identify_torques([record_of("fast rows", rates, motors, 500)])
        assert fit.clock == pytest.approx(truth.delay, abs=0.0015)
        assert fit.value[:2] == pytest.approx([truth.up, truth.down], rel=0.1)


@pytest.mark.parametrize("cycles", [2, 4])
def test_motors_that_are_logged_some_cycles_late_are_not_slow(cycles):
    """In rows of every cycle a search that begins on the wrong side of the clock ends at
    twice the lag and half the gain.
    """
    (seen,), (motors,) = fly([Truth()], 5.0)
    late = np.roll(motors, cycles, axis=0)
    record = record_of("late", seen, late, 500).rows(slice(10, None))
    fit = identify_torques([record])
    deviation = np.sqrt(np.diag(fit.covariance))
    names = dict(zip(NAMES, zip(fit.value, deviation, strict=True), strict=True))
    for name in ("spin_up", "spin_down"):
        assert names[name][0] == pytest.approx(0.025, rel=0.06)
        assert abs(names[name][0] - 0.025) < 1.645 * names[name][1]
    assert fit.value[3:6] == pytest.approx(1.0, abs=0.05)
    assert fit.clock == pytest.approx(-0.002 * cycles, abs=0.002)
    for axis, pair in responses([record], fit).items():
        if axis in ("roll", "pitch"):
            assert pair.measured.at(5.0)[0] == pytest.approx(pair.simulated.at(5.0)[0], rel=0.06)


@pytest.mark.parametrize("name", ["nominal", "slow motors"])
def test_rows_of_means_whose_motors_are_logged_late_are_not_quick_and_weak(name):
    """Motors late by part of a row hold the search at its beginning; late by more, they
    have the larger likelihood there.
    """
    truth = TRUTHS[name]
    (seen,), (motors,) = fly([truth], 20.0)
    for cycles in (2, 3, 6):
        late = np.roll(motors, cycles, axis=0)
        fit = identify_torques([record_of("late", seen[10:], late[10:], 100)])
        assert fit.clock == pytest.approx(truth.delay - 0.002 * cycles, abs=0.0015)
        assert fit.value[:2] == pytest.approx([truth.up, truth.down], rel=1.0 / 6.0)
        assert fit.value[3:6] == pytest.approx(1.0, abs=0.12)


def test_no_line_stands_for_motors_that_were_not_logged():
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(960)
    motor = 0.6 + 0.05 * rng.standard_normal((960, 4))

    def case_without(lost):
        logged = np.where(lost[:, None], np.nan, motor)
        rates = rng.standard_normal((960, 3))
        flight = Flight("a", "a", "0", time, body_rates=rates, motor_command=logged)
        return Case("holes", (flight,), load_vehicle_file())

    holes = (time % 3.0 > 2.7) | (time % 3.0 == 1.0)  # a single row is no hole
    case = case_without(holes)
    for moved in (case, case_on_gyroscope_clock(case, {"a": 0.02})):
        parts = own_tracks(moved)
        assert [len(r) for r in parts] == pytest.approx([270] * 3, abs=3)
        assert not any(r.bridges_holes for r in parts)
    assert all(r.bridges_holes for r in own_tracks(case_without(time % 0.5 > 0.3)))


def test_a_gyroscope_that_reads_too_much_is_no_lighter_body(monkeypatch):
    """With a reference both are read with its gain: of two gains, each with its error,
    a change of inertia would come.
    """
    asked = []
    monkeypatch.setattr(evidence, "identify", lambda case, *_: asked.append(case))
    rates = np.full((900, 3), 1.1)
    flight = Flight("a", "a", "0", 0.01 * np.arange(900), body_rates=rates)
    read = evidence.Evidence(
        Case("fast", (flight,), load_vehicle_file()),
        **dict.fromkeys(("library", "vehicles", "channels", "motion")),
        tracks=[],
        sensors=Kinematics(gain=1.1, tilt=None, one_clock=True, findings={}),
    )
    before = SimpleNamespace(identification=SimpleNamespace(gyroscope_gain=1.0))
    for case in (read, replace(read, baseline=before)):
        evidence.with_identification(case)
    alone, beside = (case.flights[0].body_rates for case in asked)
    assert np.allclose(alone, 1.0) and np.allclose(beside, 1.1)


def test_a_hover_that_hardly_turns_says_nothing_of_torques(monkeypatch, records):
    monkeypatch.setattr(rate_flights, "COMMANDS", 0.0)
    (seen,), (motors,) = fly([Truth(gust=0.3)], 8.0)
    still = record_of("hover", seen, motors, 100)
    assert doubts([still], identify_torques([still], one_clock=False), one_clock=True)
    moving = records["nominal"]
    assert not doubts([moving], identify_torques([moving]), one_clock=True)
