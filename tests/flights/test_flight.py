"""The flight container: slower channels, gaps and neighbours are handled once, for
everyone behind it.
"""

from dataclasses import replace

import numpy as np
import pytest

from openjax.flights.airborne import airborne_part
from openjax.flights.flight import Case, Flight
from openjax.flights.grid import TAKE_OFF, flight_tracks, own_tracks
from openjax.vehicle.vehicle_file import load_vehicle_file


def flight(time, **channels):
    return Flight("log.csv:0", "log.csv", "0", np.asarray(time, float), **channels)


def test_slower_channels_are_interpolated_between_their_own_samples():
    voltage = np.array([4.0, np.nan, np.nan, np.nan, 3.6])
    f = flight([0, 1, 2, 3, 4], battery_voltage=voltage)
    np.testing.assert_allclose(f.interpolated("battery_voltage"), [4.0, 3.9, 3.8, 3.7, 3.6])
    at, values = f.sampled("battery_voltage")
    assert at.tolist() == [0, 4] and values.tolist() == [4.0, 3.6]


def test_interpolated_attitudes_are_unit_and_rows_sampled_in_part_do_not_count():
    angle = np.array([0.0, 0.2, np.nan])
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], 1)
    quaternion[2, 0] = 1.0
    f = flight([0, 1, 2], quaternion=quaternion)
    middle = f.interpolated("quaternion", np.array([0.5]))[0]
    np.testing.assert_allclose(middle, [np.cos(0.05), 0, 0, np.sin(0.05)], atol=1e-6)
    assert len(f.sampled("quaternion")[0]) == 2


def test_stretches_break_at_gaps_and_rows_cut_every_channel():
    time = np.r_[np.arange(0, 1, 0.01), np.arange(1.5, 3, 0.01)]
    f = flight(time, motor_command=np.zeros((250, 4)))
    assert f.stretches() == [slice(0, 100), slice(100, 250)]
    assert f.stretches(min_duration=1.2) == [slice(100, 250)]
    part = f.rows(f.stretches()[1])
    assert len(part) == 150 and part.motor_command.shape == (150, 4) and part.position is None


def test_others_are_those_of_the_same_log():
    first = flight([0, 1])
    second = Flight("log.csv:1", "log.csv", "1", np.array([0.0, 1.0]))
    elsewhere = Flight("b.csv:1", "b.csv", "1", np.array([0.0, 1.0]))
    case = Case("case", (first, second, elsewhere), vehicle_file=None)
    assert case.others(first) == (second,) and case.others(elsewhere) == ()


@pytest.mark.parametrize("rate", [100, 200, 250, 500])
def test_faster_logs_become_means_over_the_rows_of_the_grid(rate):
    """Motors hold until the next row; sensors are straight between rows and averaged
    around a grid point.
    """
    time = np.arange(0.0, 4.0, 1 / rate)
    jumps = np.floor(time / 0.004 + 1e-9) % 7 / 10.0
    ramp = np.stack([time, 2 * time, -time], 1)
    f = flight(time, motor_command=np.repeat(jumps[:, None], 4, 1), body_rates=ramp)
    (track,) = flight_tracks(f, Case("case", (f,), load_vehicle_file()))
    assert track.dt == pytest.approx(0.01)
    held = np.repeat(jumps, 1000 // rate)  # every ms
    expected = held[: len(held) // 10 * 10].reshape(-1, 10).mean(1) if rate > 100 else jumps
    rows = slice(1, len(track) - 2)
    np.testing.assert_allclose(track.motor[rows, 0], expected[: len(track)][rows], atol=1e-9)
    np.testing.assert_allclose(
        track.body_rates[rows], np.outer(track.time, [1, 2, -1])[rows], atol=1e-9
    )


def test_a_track_ends_where_the_body_is_known():
    """No pose is held beyond the last one: it would stand still while the body flies."""
    time = np.arange(0.0, 4.0, 0.01)
    path = np.stack([time, 0 * time, 0 * time + 0.5], 1)
    path[np.arange(len(time)) % 7 != 3] = np.nan
    logged = {"motor_command": np.full((400, 4), 0.5), "body_rates": np.zeros((400, 3))}
    f = Flight("log.csv:0", "log.csv", "0", time, position=path, **logged)
    (track,) = flight_tracks(f, Case("case", (f,), load_vehicle_file()))
    assert len(track) > 390
    np.testing.assert_allclose(np.diff(track.position[:, 0]), 0.01)


@pytest.mark.parametrize("below", [0.0, -1.3, 0.4])
def test_heights_of_tracks_are_above_the_floor(below):
    """Wherever a lab's z begins: ground and ceiling effect ask for the distance to
    them.
    """
    time = np.arange(0.0, 4.0, 0.01)
    path = np.stack([time, 0 * time, 0.5 + 0.1 * np.sin(time)], 1)
    shift = np.array([0.0, 0.0, below])
    logged = {"motor_command": np.full((400, 4), 0.5), "body_rates": np.zeros((400, 3))}
    flights = [
        Flight("log.csv:" + name, "log.csv", name, time, position=place + shift, **logged)
        for name, place in (("low", path), ("high", path + np.array([0.0, 0.0, 0.4])))
    ]
    file = replace(load_vehicle_file(), log={"floor_z": below, "ceiling_z": 2.0 + below})
    (track,) = flight_tracks(flights[0], Case("case", tuple(flights), file))
    np.testing.assert_allclose(track.position, path[: len(track)], atol=1e-9)
    np.testing.assert_allclose(track.neighbours[0, :, 2] - track.position[:, 2], 0.4)
    assert track.ceiling == pytest.approx(2.0)


@pytest.mark.parametrize("begins_in_the_air", [True, False])
def test_a_dip_of_the_thrust_is_no_landing_and_a_take_off_tells_nothing(begins_in_the_air):
    """Of torques, while the floor still acts; the one rule holds for rows of any clock."""
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(1000)
    motors = 0.6 + 0.02 * rng.standard_normal((1000, 4))
    motors[(time > 6.0) & (time < 6.4)] *= 0.2  # a manoeuvre
    if not begins_in_the_air:
        motors[time < 2.0] *= 0.2
    logged = flight(time, body_rates=rng.standard_normal((1000, 3)), motor_command=motors)
    in_air = airborne_part(logged, None, lambda kind, text: None)
    (track,) = own_tracks(Case("case", (in_air,), load_vehicle_file()))
    begin = 0.0 if begins_in_the_air else 2.0 + TAKE_OFF
    assert track.time[0] == pytest.approx(begin, abs=0.02)
    assert track.time[-1] == pytest.approx(9.97, abs=0.02)
    assert in_air.in_the_air(time).tolist() == (time >= (2.0 if begin else 0.0)).tolist()
