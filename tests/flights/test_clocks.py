"""When motors act: a shift of a row is found and undone, another clock is a finding,
and motors that are slow are neither.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.flights import clocks
from openjax.flights.case import load_case
from openjax.flights.clocks import (
    case_on_gyroscope_clock,
    on_gyroscope_clock,
    read_command_clock,
    read_motor_clock,
)
from openjax.flights.flight import Case, Flight
from openjax.flights.grid import tracks_of
from openjax.flights.motor_delay import row_torques
from openjax.flights.track import Track
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_numbers import with_values

VEHICLE = load_vehicle()


@pytest.fixture(scope="module")
def tracks(sample_columns, tmp_path_factory):
    """Of three sample flights; a row's motors are the mean until the next row."""
    from openjax.flights.csv_table import write_csv
    from openjax.flights.samples import log_of

    folder = tmp_path_factory.mktemp("case")
    (folder / "vehicle.toml").write_text("")
    for name, columns in sample_columns.items():
        write_csv(folder / f"{name}.csv", log_of([columns], name))
    return tracks_of(load_case(folder))


def moved(track: Track, late: float) -> Track:
    """The track as a logger would write it whose motor commands stand `late` s too
    late.
    """
    motor = [np.interp(track.time - late, track.time, column) for column in track.motor.T]
    return dataclasses.replace(track, motor=np.stack(motor, 1))


def slower(track: Track, time: float) -> Track:
    """The track as if its motors had a time constant that is longer by `time` s: the
    body answers what motors did before.
    """
    kept = np.exp(-track.dt / time)
    rates = track.body_rates.copy()
    for row in range(1, len(rates)):
        rates[row] = kept * rates[row - 1] + (1.0 - kept) * track.body_rates[row]
    return dataclasses.replace(track, body_rates=rates)


def answered(track: Track, time: float) -> Track:
    """The track as if its motors had another time constant: the body is turned by what
    they do through it, and by all else as it was.
    """
    place = np.asarray(VEHICLE.rotor_position, float)
    usual, torques = (
        row_torques(track.motor, place, lag, track.dt)[:-1]
        for lag in (float(VEHICLE.motor_time_constant), time)
    )
    changes = np.diff(track.body_rates[:, :2], axis=0)
    gain = (usual * changes).sum(0) / (usual**2).sum(0)
    rates = track.body_rates.copy()
    rates[1:, :2] += gain * np.cumsum(torques - usual, axis=0)
    return dataclasses.replace(track, body_rates=rates)


def read(tracks, row=0.01, time=None, **said):
    vehicle = VEHICLE if time is None else with_values(VEHICLE, motor_time_constant=time)
    return read_motor_clock(tracks, [vehicle] * len(tracks), row, **said)


def test_motors_that_act_from_their_row_on_are_no_finding(tracks):
    assert read(tracks) == clocks.MotorClock({}, True, {})
    assert read([moved(t, 0.005) for t in tracks], rows="sample") == read(tracks)
    assert read([moved(t, 0.004) for t in tracks], row=0.001) == read(tracks)


def test_rotors_that_turn_the_body_as_they_speed_up_are_no_shift(tracks):
    """In yaw their reaction comes 20 to 30 ms before their drag."""

    def yawing(track):
        yaw = np.interp(track.time + 0.025, track.time, track.body_rates[:, 2])
        gusts = np.random.default_rng(0).standard_normal((len(track), 2))
        return dataclasses.replace(track, body_rates=np.column_stack([gusts, yaw]))

    assert read([yawing(t) for t in tracks]) == read(tracks)


def test_a_flight_whose_loop_answers_late_is_no_clock(tracks):
    """As in another's wake, which turns the body before the motors answer."""
    late = [moved(t, -0.04) if k == 1 else t for k, t in enumerate(tracks)]
    assert read(late) == read(tracks)


def test_a_flight_that_turns_slowly_tells_no_clock_of_its_own():
    """At 30 ms beside its peak the likeness of turns of about 1 Hz is still nine tenths
    of it.
    """
    time = 0.01 * np.arange(2000)
    turns = [np.sin(2 * np.pi * f * time) for f in np.linspace(0.83, 1.37, 18)]
    slow = np.stack(turns, 1).reshape(len(time), 3, 6).sum(2)
    noise = np.random.default_rng(0).normal(size=slow.shape)

    def offsets(late):  # of a slow flight, beside a fast one whose signals are at once
        signals = zip(("slow", "fast"), (slow, noise), (late, 0), strict=True)
        return clocks._offsets(
            (SimpleNamespace(name=n, dt=0.01), np.roll(v, rows, 0), v) for n, v, rows in signals
        )

    assert offsets(3) == pytest.approx({"slow": 0.0, "fast": 0.0}, abs=0.003)
    assert offsets(15)["slow"] == pytest.approx(0.15, abs=0.003)


@pytest.mark.parametrize("time", [0.02, 0.05, 0.095])
def test_slow_motors_are_no_clock(tracks, time):
    assert read([slower(t, time) for t in tracks]) == read(tracks)


@pytest.mark.parametrize("nominal, true", [(0.025, 0.008), (0.057, 0.025), (0.057, 0.008)])
def test_quick_motors_are_no_clock(tracks, nominal, true):
    """However slow the simulator's are: they act after their commands all the same."""
    quick = [answered(t, true) for t in tracks]
    assert read(quick, time=nominal) == clocks.MotorClock({}, True, {})
    # a row's shift is one beside them, too
    shifted = read([moved(t, 0.01) for t in quick], time=nominal)
    assert shifted.one_clock and list(shifted.findings) == ["motor rows"]


@pytest.mark.parametrize("nominal", [0.025, 0.057])
def test_rows_that_hold_what_acted_before_them_are_read_a_row_earlier(tracks, nominal):
    shifted = [moved(t, 0.01) for t in tracks]
    found = read(shifted, time=nominal)
    assert found.one_clock and list(found.findings) == ["motor rows"]
    for logged, track in zip(tracks, shifted, strict=True):
        back = on_gyroscope_clock(track, found)
        np.testing.assert_allclose(back.motor[1:-1], logged.motor[1:-1], atol=1e-9)
        assert back.motors_logged
    said = read(shifted, rows="mean_before")
    assert said.late == found.late and not said.findings


@pytest.mark.parametrize("late", [-0.25, -0.14, -0.08, 0.04, 0.08, 0.14, 0.25])
@pytest.mark.parametrize("which", [slice(None), slice(1, 2)])
def test_motors_on_another_clock_are_a_finding(tracks, late, which):
    """In all flights or in one: commands are put where they act, and tell no
    torques.
    """
    rest = range(len(tracks))[which]
    mixed = [moved(t, late) if k in rest else t for k, t in enumerate(tracks)]
    found = read(mixed)
    assert not found.one_clock and list(found.findings) == ["motor clock"]
    words = found.findings["motor clock"]
    assert words.count(" ms ") == len(rest) == words.count(" ms late" if late > 0 else " ms early")
    for number in rest:
        name = mixed[number].name
        assert found.late[name] == pytest.approx(late, abs=0.0076)
        assert not on_gyroscope_clock(mixed[number], found).motors_logged


def test_flights_are_put_in_time_as_their_tracks_are(tracks):
    flight = Flight("a", "a", "0", tracks[0].time, motor_command=tracks[0].motor)
    case = Case("case", (flight, dataclasses.replace(flight, name="b")), None)
    first, second = case_on_gyroscope_clock(case, {"a": 0.02}).flights
    np.testing.assert_allclose(first.motor_command[:-2], flight.motor_command[2:], atol=1e-9)
    assert second.motor_command is flight.motor_command


@pytest.mark.parametrize("late", [-0.25, -0.14, -0.05, 0.0, 0.01, 0.05, 0.14, 0.25])
def test_commands_that_motors_obey_before_they_were_sent_are_a_finding(tracks, late):
    """Commands of the link's delay earlier, and a row late, are none."""
    sent = [np.interp(t.time - late, t.time, t.command[:, 0]) for t in tracks]
    mixed = [
        dataclasses.replace(t, command=np.c_[thrust, t.command[:, 1:]])
        for t, thrust in zip(tracks, sent, strict=True)
    ]
    words = read_command_clock(mixed, 0.01)
    usual = -0.1 < late < 0.02
    assert words.count(" ms late" if late > 0 else " ms early") == len(tracks) * (not usual)
    assert bool(words) != usual


def test_motors_that_turn_nothing_tell_no_clock(tracks):
    rng = np.random.default_rng(0)
    calm = [
        dataclasses.replace(
            t, motor=0.6 + 0.01 * rng.standard_normal(t.motor.shape), body_rates=0 * t.body_rates
        )
        for t in tracks
    ]
    assert read(calm) == clocks.MotorClock({}, True, {})
    bare = [dataclasses.replace(t, motor=None) for t in tracks]
    assert read(bare) == read(calm)
