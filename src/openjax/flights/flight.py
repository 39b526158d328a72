"""The flight container: what one vehicle's log holds, as arrays in the frames and units
of the log format.

A case is a set of flights of the same vehicle(s) with one vehicle file. World frame: x
east, y north, z up. Body frame: x forward, y left, z up. SI units. Quaternions are
scalar-first and rotate body to world.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from openjax.vehicle.vehicle_file import VehicleFile

Array = np.ndarray

# Channel of a Flight, which is None where it wasn't logged: its columns in the log format.
CHANNEL_COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "body_rates": ("wx", "wy", "wz"),
    "specific_force": ("ax", "ay", "az"),
    "command_thrust": ("cmd_thrust",),
    "command_body_rates": ("cmd_wx", "cmd_wy", "cmd_wz"),
    "motor_command": ("m1", "m2", "m3", "m4"),
    "rotor_speed": ("w1", "w2", "w3", "w4"),
    "battery_voltage": ("vbat",),
}
HOLE = 0.5  # s, longest time without a sample over which a line is drawn
SENSORS = ("position", "quaternion", "velocity", "body_rates", "specific_force")


@dataclass(frozen=True)
class Issue:
    """One finding about a flight's data.

    `flight` is the log's file name (with the vehicle's id where several flew), `issue` says in
    words what was found, `refused` whether the flight can't be used because of it, and `kind` is a
    short name of the check. `against` names the comparisons of channels that failed.
    """

    flight: str
    issue: str
    refused: bool = False
    kind: str = ""
    against: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Flight:
    """One vehicle's flight, T rows sorted by time, float64. A channel that wasn't
    logged is None; a value that wasn't sampled at a row (slower channels) is NaN.
    Motors are in the nominal order: front right, rear right, rear left, front left.
    """

    name: str  # log file name; "FILE:ID" where several vehicles share the file
    log: str  # log file name: flights with the same `log` flew together
    vehicle: str  # vehicle id, "0" by default
    time: Array  # (T,) s
    position: Array | None = None  # (T, 3) m, world, of the tracked frame
    # (T, 4) wxyz, body to world, unit, without sign flips
    quaternion: Array | None = None
    velocity: Array | None = None  # (T, 3) m/s, world
    body_rates: Array | None = None  # (T, 3) rad/s, gyroscope
    # (T, 3) m/s^2, body, accelerometer (+9.81 on z at rest)
    specific_force: Array | None = None
    command_thrust: Array | None = (
        None  # (T,) commanded collective thrust, as a share of the largest
    )
    command_body_rates: Array | None = None  # (T, 3) rad/s, commanded body rates
    # (T, 4) 0..1, meaning by the vehicle file's `motor_command`
    motor_command: Array | None = None
    rotor_speed: Array | None = None  # (T, 4) rad/s, measured
    battery_voltage: Array | None = None  # (T,) V, under load
    # True: differentiated from position by the reader, not logged
    velocity_derived: bool = False
    # what the log's format says of its motors, where it says anything
    duty_cycles: bool = False
    # s that the log's clock read at time 0; None: it is the vehicle's own
    clock_start: float | None = None
    body_rates_derived: bool = (
        False  # True: differentiated from the attitude by the reader, no gyroscope
    )
    # True: of gyroscope, accelerometer and path by the reader
    attitude_derived: bool = False
    pose_age: float = (
        # s by which a pose may be older than its row, because the log held the last one
        0.0
    )
    # (A, 2) s, take-off and landing of each stretch in the air; infinite where the log
    # begins or ends there. By the checks; None: not told yet
    airborne: Array | None = None
    # hash of the whole log's values, the same for copies under other names
    fingerprint: str = ""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """s, from the first row to the last."""
        return float(self.time[-1] - self.time[0]) if len(self.time) > 1 else 0.0

    @property
    def row_period(self) -> float:
        """s, median step between rows."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else float("nan")

    @property
    def has_pose(self) -> bool:
        """True if position and attitude are logged."""
        return self.position is not None and self.quaternion is not None

    @property
    def has_imu(self) -> bool:
        """True if gyroscope and accelerometer are logged."""
        return self.body_rates is not None and self.specific_force is not None

    @property
    def has_motors(self) -> bool:
        """True if motor commands are logged."""
        return self.motor_command is not None

    @property
    def has_commands(self) -> bool:
        """True if commanded thrust and body rates are logged."""
        return self.command_thrust is not None and self.command_body_rates is not None

    def sampled(self, channel: str) -> tuple[Float[Array, " samples"], Float[Array, "samples ..."]]:
        """Times (S,) and values (S, ...) of the rows at which `channel` was sampled in full."""
        values = getattr(self, channel)
        if values is None:
            raise ValueError(f"{self.name}: no channel {channel}")
        rows = np.isfinite(values.reshape(len(values), -1)).all(1)
        return self.time[rows], values[rows]

    def in_the_air(self, time: Float[Array, " times"], clear: float = 0.0) -> Bool[Array, " times"]:
        """(S,) at which times it flies, with its last take-off and its next landing at
        least `clear` s away.
        """
        if self.airborne is None:
            return np.ones(len(time), bool)
        take_off, landing = self.airborne.T[:, :, None]
        return ((time >= take_off + clear) & (time <= landing - clear)).any(0)

    def holes(
        self, channel: str, least: float = HOLE, samples: float = 10.0
    ) -> Float[Array, "holes 2"]:
        """(H, 2) s, begin and end of where `channel` wasn't sampled for so long that no line may
        stand for it: for more than `least` s, and more than so many of its `samples`.
        """
        at = np.r_[self.time[0], self.sampled(channel)[0], self.time[-1]]
        steps = np.diff(at)
        gaps = np.flatnonzero(steps > max(least, samples * np.median(steps)))
        return np.stack([at[gaps], at[gaps + 1]], 1)

    def in_holes(
        self, channels: Iterable[str], least: float = HOLE, samples: float = 10.0
    ) -> Bool[Array, " rows"]:
        """(T,) which rows lie in a hole, see `holes`, of one of the channels that were logged."""
        inside = np.zeros(len(self), bool)
        for channel in channels:
            if getattr(self, channel) is not None:
                for begin, end in self.holes(channel, least, samples):
                    inside |= (self.time > begin) & (self.time < end)
        return inside

    def interpolated(
        self, channel: str, time: Float[Array, " times"] | None = None
    ) -> Float[Array, ...]:
        """`channel` at `time` (S,) (default: every row), linearly between its samples,
        held at the ends.

        Quaternions are interpolated componentwise and normalised, which is exact to
        second order in the step.
        """
        time = self.time if time is None else time
        at, values = self.sampled(channel)
        flat = values.reshape(len(values), -1)
        out = np.stack([np.interp(time, at, column) for column in flat.T], 1)
        if channel == "quaternion":
            out /= np.linalg.norm(out, axis=1, keepdims=True)
        return out.reshape((len(time), *values.shape[1:]))

    def stretches(self, max_step: float | None = None, min_duration: float = 0.0) -> list[slice]:
        """Slices of rows without a gap in time longer than `max_step` s (default 5 row periods)."""
        max_step = 5.0 * self.row_period if max_step is None else max_step
        breaks = np.flatnonzero(np.diff(self.time) > max_step) + 1
        edges = [0, *breaks.tolist(), len(self.time)]
        slices = [slice(a, b) for a, b in itertools.pairwise(edges)]
        return [s for s in slices if self.time[s.stop - 1] - self.time[s.start] >= min_duration]

    def rows(self, rows: slice | Array) -> Flight:
        """The flight with a subset of its rows."""
        channels = {
            c: getattr(self, c)[rows] for c in CHANNEL_COLUMNS if getattr(self, c) is not None
        }
        return dataclasses.replace(self, time=self.time[rows], **channels)


@dataclass(frozen=True, eq=False)
class Case:
    """Flights of the same vehicle(s), their vehicle file, and what the checks found,
    refused flights included.
    """

    name: str
    flights: tuple[Flight, ...]
    vehicle_file: VehicleFile
    quality: tuple[Issue, ...] = ()
    path: Path | None = None

    def others(self, flight: Flight) -> tuple[Flight, ...]:
        """The other vehicles that flew together with `flight` (neighbours, for downwash)."""
        return tuple(f for f in self.flights if f.log == flight.log and f.vehicle != flight.vehicle)

    def left_out(self) -> tuple[Issue, ...]:
        """The reason for which a log or a vehicle of it was refused."""
        return tuple(issue for issue in self.quality if issue.refused)

    def vehicle_of(self, flight: Flight):
        """The nominal `Vehicle` of this flight: the vehicle file's, with
        `[vehicles.<id>]` applied.
        """
        return self.vehicle_file.vehicle_of(flight.vehicle)


Finding = tuple[str, str, Sequence[str]]
"""Of a check of channels: kind, words, and the comparisons that fail."""


class Refused(Exception):
    """A flight that can't be used: of which kind the reason is, and the reason."""

    def __init__(self, kind: str, reason: str):
        super().__init__(reason)
        self.kind = kind
