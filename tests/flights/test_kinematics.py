"""Sensors against each other: what is wrong with a sensor is found, measured and
corrected, whatever flies.
"""

import dataclasses

import numpy as np
import pytest

from openjax.flights import kinematics
from openjax.flights.kinematics import correct
from openjax.flights.track import Track, rotation
from openjax.gap.decision import DECISION


def read_kinematics(tracks):
    return kinematics.read_kinematics(tracks, DECISION)


def _track(gain=1.0, tilt=0.0, scale=1.0, seed=1, rows=1500):
    """A made flight: smooth rates, attitude by integration, a path whose acceleration
    the accelerometer feels.
    """
    rng = np.random.default_rng(seed)
    dt = 0.01
    time = dt * np.arange(rows)
    rates = np.stack(
        [1.5 * np.sin(2 * np.pi * f * time + k) for k, f in enumerate((0.9, 1.3, 0.6))], 1
    )
    quaternion = np.zeros((rows, 4))
    quaternion[0, 0] = 1.0
    for k in range(1, rows):
        half = 0.25 * dt * (rates[k] + rates[k - 1])
        w = quaternion[k - 1, 0]
        u = quaternion[k - 1, 1:]
        quaternion[k] = np.r_[w - u @ half, u + w * half + np.cross(u, half)]
        quaternion[k] /= np.linalg.norm(quaternion[k])
    acceleration = np.stack([np.sin(2 * np.pi * f * time) for f in (0.5, 0.7, 0.4)], 1)
    velocity = np.cumsum(acceleration, 0) * dt
    force = np.einsum("tji,tj->ti", rotation(quaternion), acceleration + np.array([0.0, 0.0, 9.81]))
    lean = np.array(
        [[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]]
    )
    half = np.array([np.sin(tilt / 2), 0.0, 0.0])
    w = quaternion[:, :1]
    u = quaternion[:, 1:]
    leaned = np.concatenate([w * np.cos(tilt / 2) - u @ half[:, None], u * np.cos(tilt / 2) + w * half
                             + np.cross(half, u)], 1)  # fmt: skip
    return Track(
        name="a", flight="a", dt=dt, time=time, position=scale * dt * np.cumsum(velocity, 0) @ lean.T, quaternion=leaned,
        velocity=velocity @ lean.T + 0.005 * rng.standard_normal((rows, 3)),
        body_rates=gain * rates + 0.02 * rng.standard_normal((rows, 3)) + 0.01,
        specific_force=force + 0.15 * rng.standard_normal((rows, 3)) + np.array([0.2, -0.1, 0.1]),
        command=None, motor=None, voltage=None, neighbours=np.zeros((0, rows, 3)),
    )  # fmt: skip


def test_sensors_that_agree_are_no_finding():
    assert read_kinematics([_track(), _track(seed=2)]).findings == {}


@pytest.mark.parametrize("gain", [0.85, 0.95, 1.05, 1.15])
def test_a_gyroscope_with_another_gain_is_found_and_corrected(gain):
    tracks = [_track(gain=gain)]
    found = read_kinematics(tracks)
    unusual = abs(gain - 1.0) > DECISION.gyroscope_gain
    assert (
        found.gain == pytest.approx(gain, abs=0.01)
        and list(found.findings) == ["gyroscope gain"] * unusual
    )
    assert read_kinematics([correct(t, found) for t in tracks]).gain == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("scale", [0.8, 1.05, 1.2])
def test_positions_in_another_scale_than_the_accelerometers_are_a_finding(scale):
    unusual = abs(scale - 1.0) > DECISION.gyroscope_gain
    assert list(read_kinematics([_track(scale=scale)]).findings) == ["scale"] * unusual


def test_a_world_that_leans_is_found_and_put_upright():
    tracks = [_track(tilt=np.radians(4.0))]
    found = read_kinematics(tracks)
    assert np.degrees(found.tilt) == pytest.approx([4.0, 0.0], abs=0.4) and list(
        found.findings
    ) == ["world tilt"]
    assert read_kinematics([correct(t, found) for t in tracks]).findings == {}


@pytest.mark.parametrize("missing", ["position", "velocity"])
def test_an_upright_world_needs_no_position(missing):
    """What was logged is turned, neighbours too; what wasn't is left alone."""
    track = _track(tilt=np.radians(4.0))
    found = read_kinematics([track])
    beside = track.position + np.array([0.0, 0.0, 0.5])
    bare = dataclasses.replace(track, neighbours=beside[None], **{missing: None})
    upright = correct(bare, found)
    assert getattr(upright, missing) is None
    logged = correct(dataclasses.replace(track, neighbours=beside[None]), found)
    apart = logged.neighbours[0] - logged.position
    assert np.allclose(np.linalg.norm(apart, axis=1), 0.5)
    assert np.allclose(apart[0], apart[-1]) and abs(apart[0, 1]) > 0.02
    np.testing.assert_array_equal(upright.neighbours, logged.neighbours)


def test_streams_on_clocks_that_wander_tell_no_gain():
    track = _track()
    late = np.interp(track.time + 0.12 * np.sin(track.time), track.time, track.time)
    rates = np.stack([np.interp(late, track.time, c) for c in 1.1 * track.body_rates.T], 1)
    assert set(read_kinematics([dataclasses.replace(track, body_rates=rates)]).findings) == {
        "clocks"
    }


def test_noise_of_an_attitude_is_no_matter_of_clocks():
    rng = np.random.default_rng(3)
    time = 0.01 * np.arange(3000)

    def signal(at):
        return np.stack([np.sin(2 * np.pi * f * at) * np.sin(0.3 * at) for f in (0.9, 1.3, 0.6)], 1)

    noisy = signal(time) + 0.5 * rng.standard_normal((3000, 3))
    apart = signal(time + 0.04 * np.sign(np.sin(2.0 * time)))
    assert kinematics._wander([(0.01, signal(time), noisy)]) < 0.01
    assert kinematics._wander([(0.01, signal(time), apart)]) > 0.03
