"""A track: one stretch of a flight on a uniform clock, the arrays that replays and
identifications run on, and what is computed of its rows.

`openjax.flights.grid` makes them of a case's flights.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d
from scipy.spatial.transform import Rotation

from openjax.flights.shapes import Columns, Quaternions, Vectors

Array = np.ndarray
GRAVITY = 9.81  # m/s^2
LOOP_ROWS = 0.003  # s: rows as short show every cycle of the rate loop


@dataclass(frozen=True, eq=False)
class Track:
    """One stretch of one vehicle's flight, T rows of period `dt`. Units and frames are those of
    `Flight`; motors are fractions of the maximal rotor thrust. What wasn't logged is None.
    """

    name: str
    flight: str  # name of the flight it comes from: the unit that is held out
    dt: float
    time: Array  # (T,)
    body_rates: Array  # (T, 3)
    position: Array | None = None  # (T, 3), z above the floor
    quaternion: Array | None = None  # (T, 4)
    velocity: Array | None = None  # (T, 3)
    specific_force: Array | None = None  # (T, 3)
    command: Array | None = None  # (T, 4) thrust 0..1, body rates rad/s
    motor: Array | None = None  # (T, 4) 0..1 thrust fraction
    rotor_speed: Array | None = None  # (T, 4) rad/s, measured, at the rows' times
    voltage: Array | None = None  # (T,)
    # (K, T, 3) m, positions of the vehicles that flew along
    neighbours: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    pose_age: float = 0.0  # s by which the pose may be older than its row, see `Flight`
    # False: made by the nominal rate controller from the commands
    motors_logged: bool = True
    # a row's motors are one sample of a faster loop, not the mean over the row
    samples: bool = False
    # lines stand for motors or body rates that weren't logged
    bridges_holes: bool = False
    # of logs faster than the grid: times (S,) s, mean of the motors (S,)
    fast_thrust: tuple[Array, Array] | None = None
    attitude_derived: bool = False  # of gyroscope, accelerometer and path, not measured
    ceiling: float | None = None  # m above the floor; None: no ceiling is known
    # (T,) rows that weren't logged: lines between their neighbours
    missing: Array | None = None
    vehicle: Any = None  # its nominal `Vehicle`

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, rows: slice) -> Track:
        """The track with some of its rows, without what isn't of rows."""
        channels = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "neighbours"}
        cut = {n: v[rows] for n, v in channels.items() if isinstance(v, np.ndarray)}
        neighbours = self.neighbours[:, rows] if len(self.neighbours) else self.neighbours
        return replace(self, **cut, neighbours=neighbours, fast_thrust=None)

    @property
    def hides_ticks(self) -> bool:
        """True if the rate loop ran several times within a row."""
        return self.dt > LOOP_ROWS

    @property
    def logs_attitude(self) -> bool:
        """True if there is an attitude in which the gyroscope has no part."""
        return self.quaternion is not None and not self.attitude_derived


def smooth(
    values: Float[Array, " rows *columns"], width: float, dt: float
) -> Float[Array, " rows *columns"]:
    """`values` (T, ...) smoothed by a Hann window of `width` s, ends held."""
    n = max(round(width / dt), 1)
    if n < 2:
        return values
    window = np.hanning(n + 2)[1:-1]
    return convolve1d(values, window / window.sum(), axis=0, mode="nearest", origin=n % 2 - 1)


def rotation(quaternion: Quaternions) -> Float[Array, "rows 3 3"]:
    """Rotation matrices (T, 3, 3), body to world, of quaternions (T, 4) wxyz."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def to_body(quaternion: Quaternions, vector: Vectors) -> Vectors:
    """World vectors (T, 3) in the body frame of attitudes (T, 4)."""
    return np.einsum("tji,tj->ti", rotation(quaternion), vector)


def to_world(quaternion: Quaternions, vector: Vectors) -> Vectors:
    """Body vectors (T, 3) in the world."""
    return np.einsum("tij,tj->ti", rotation(quaternion), vector)


def specific_force_of(quaternion: Quaternions, velocity: Vectors, period: float) -> Vectors:
    """Force per mass (T, 3), m/s^2 in the body frame, that a path with velocities (T,
    3) every `period` s needs.
    """
    return to_body(
        quaternion, np.gradient(velocity, period, axis=0) + np.array([0.0, 0.0, GRAVITY])
    )


def turn_increments(quaternion: Quaternions) -> Float[Array, "turns 3"]:
    """Rotation vectors (T - 1, 3), body frame, between successive attitudes (T, 4)."""
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    return (attitude[:-1].inv() * attitude[1:]).as_rotvec()


def earlier(values: Columns, delay: float, track: Track) -> Columns:
    """Rows (T, C) of a track as they were `delay` s earlier."""
    return np.stack([np.interp(track.time - delay, track.time, column) for column in values.T], 1)


def without_delay(track: Track, delay: float) -> Track:
    """The track with its pose `delay` s younger than logged."""
    pose = [n for n in ("position", "quaternion", "velocity") if getattr(track, n) is not None]
    channels = {n: earlier(getattr(track, n), -delay, track) for n in pose}
    channels["quaternion"] /= np.linalg.norm(channels["quaternion"], axis=1, keepdims=True)
    if len(track.neighbours):  # the same cameras saw them
        channels["neighbours"] = np.stack([earlier(p, -delay, track) for p in track.neighbours])
    return replace(track, **channels)
