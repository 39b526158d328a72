"""The estimator's path: the attitude against the integrated gyroscope. No dynamics are needed to see a
late pose."""

from __future__ import annotations

import dataclasses

import numpy as np

from openjax.flights.track import Track, smooth
from openjax.gap.linear_path import LinearPath, fit_linear_path
from openjax.gap.nuisances import POSE_SHIFT

DELAY_SPREAD = 0.02  # s
LONGEST = 0.15  # s
STEPS = 6
SMALL_STEP = 2e-4  # s
GYRO_BIAS = 0.1  # rad/s
GYRO_TILT = 0.01  # rad


def read_estimator(tracks: list[Track], flight_of) -> LinearPath:
    """How late the attitude is against the gyroscope (s, one coefficient); a clock offset of a few ms is a
    nuisance. The delay is found by Gauss-Newton steps: the body turns on meanwhile."""
    delay = 0.0
    for _ in range(STEPS):
        path = _read_around(tracks, flight_of, delay)
        found = float(np.clip(path.score()[1][0], 0.0 if delay else -LONGEST, LONGEST))
        if abs(found - delay) < SMALL_STEP or found <= delay == 0.0:
            break
        delay = max(found, 0.0)
    return path


def _read_around(tracks: list[Track], flight_of, delay: float) -> LinearPath:
    """The path linearised at a delay; its coefficient is the whole delay."""
    y, columns, nuisances = [], [], []
    for track in tracks:
        turned = turn_increments(track.quaternion)
        gyro, calm = (
            _late(v, delay, track) for v in (track.body_rates, smooth(track.body_rates, 0.03, track.dt))
        )
        between = 0.5 * (gyro[1:] + gyro[:-1]) * track.dt
        start = np.zeros((1, 3))
        late = -(calm - calm[:1])
        y.append(np.concatenate([start, np.cumsum(turned - between, 0)]) + delay * late)
        columns.append(late[None])
        time = (track.time - track.time[0])[:, None]
        drift = [GYRO_BIAS * axis * time for axis in np.eye(3)]
        tilted = [
            GYRO_TILT * np.concatenate([start, np.cumsum(np.cross(axis, between), 0)]) for axis in np.eye(3)
        ]
        nuisances.append(np.stack([*drift, *tilted, POSE_SHIFT * late]))
    return fit_linear_path(y, columns, nuisances, flight_of, (DELAY_SPREAD,), (((0, 1, 2), True),))


def _late(values: np.ndarray, delay: float, track: Track) -> np.ndarray:
    """Rows (T, 3) as they were `delay` s earlier."""
    return np.stack([np.interp(track.time - delay, track.time, column) for column in values.T], 1)


def turn_increments(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors (T - 1, 3), body frame, between successive attitudes (T, 4)."""
    a, b = quaternion[:-1], quaternion[1:]
    scalar = (a * b).sum(1)
    vector = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    return 2.0 * vector * np.sign(scalar)[:, None]


def undelayed(track: Track, delay: float) -> Track:
    """The track with its pose `delay` s younger than logged."""

    def moved(values):
        return np.stack([np.interp(track.time + delay, track.time, column) for column in values.T], 1)

    quaternion = moved(track.quaternion)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    velocity = None if track.velocity is None else moved(track.velocity)
    return dataclasses.replace(
        track, position=moved(track.position), quaternion=quaternion, velocity=velocity
    )
