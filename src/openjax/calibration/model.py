"""The equations that a calibration fits: logged motor commands through the rotors' lag to rates, velocity and
specific force, in windows, linear in everything but the lag.

Over a window of half a second the measured body rates are the rates at its start plus the integrated angular
acceleration, the measured velocity likewise. Start values are free in each window (and a constant torque and
a constant horizontal force with them), so what is fitted is how motion changes with the motor commands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from openjax.flights.track import Track, rotation

WINDOW = 0.5  # s
BLOCK = 1.0  # s, errors are taken as independent between blocks, not between rows
SETTLE = 0.15  # s at the start of a track: the rotor speeds there are unknown
LOWEST = 0.15  # m above the floor: below, the air's cushion would pass for thrust
GRAVITY = 9.81
STEP = 0.02  # of log time constant, for its derivative

MAIN = ("roll", "pitch", "yaw")  # angular acceleration per torque, as a multiple of the nominal
# Nuisances shared by all flights: standard deviation of their prior, in the unit given.
SHARED_PRIORS = {
    "clock_imu": 0.002,  # s, motor commands against IMU
    "clock_pose": 0.010,  # s, motor commands against pose
    "offset_roll": 0.005,  # m, lever of the collective thrust
    "offset_pitch": 0.005,  # m
    "offset_yaw": 0.002,  # m
    "damping_roll": 0.6,  # 1/s, the air's torque per rate and inertia: drag acts at the hubs
    "damping_pitch": 0.6,  # 1/s
    "damping_yaw": 1.5,  # 1/s
    "drag_lateral": 0.6,  # 1/s, drag per mass
    "drag_vertical": 0.6,  # 1/s
}
FLIGHT_PRIORS = {"tilt_x": 0.02, "tilt_y": 0.02, "bias_z": 0.3}  # rad, rad, m/s^2; one each per flight
MAIN_PRIORS = {"roll": 0.6, "pitch": 0.6, "yaw": 1.0, "thrust": 0.4}  # about 1
LAG_PRIOR = 0.8  # of log time constant


@dataclass(frozen=True, eq=False)
class Equations:
    """Stacked windows: y (N,) = X (N, P) beta, one row per sample and channel; `block` (N,) numbers the
    stretches of time whose errors may be correlated, `flight` (N,) the flights, `channel` (N,) the
    channels."""

    y: np.ndarray
    X: np.ndarray
    block: np.ndarray
    flight: np.ndarray
    channel: np.ndarray


def parameter_names(flights: list[str], thrust_per_flight: bool) -> list[str]:
    """Names of beta's entries: roll, pitch, yaw, thrust (or one thrust per flight), then the nuisances."""
    thrust = [f"thrust:{f}" for f in flights] if thrust_per_flight else ["thrust"]
    return [*MAIN, *thrust, *SHARED_PRIORS, *(f"{n}:{f}" for f in flights for n in FLIGHT_PRIORS)]


def prior_of(names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (P,) of each parameter's weak prior."""
    spread = MAIN_PRIORS | SHARED_PRIORS | FLIGHT_PRIORS
    kinds = [n.partition(":")[0] for n in names]
    return np.array([float(k in MAIN_PRIORS) for k in kinds]), np.array([spread[k] for k in kinds])


def build(tracks: list[Track], vehicles, names: list[str], time_constant: float, floor_z: float) -> Equations:
    """The equations of all tracks at one motor time constant (s). `vehicles` holds each track's nominal
    vehicle."""
    index = {n: i for i, n in enumerate(names)}
    flights = list(dict.fromkeys(t.flight for t in tracks))
    parts, block = [], 0
    for track, vehicle in zip(tracks, vehicles, strict=True):
        columns = _Columns(track, vehicle, index, time_constant)
        for start, stop in windows(track, floor_z):
            here = block + int((start - 1) * track.dt / BLOCK)
            for channel, y, X in columns.window(start, stop):
                parts.append((y, X, here, flights.index(track.flight), channel))
        block += int(len(track) * track.dt / BLOCK) + 2
    if not parts:
        width = len(names)
        return Equations(np.zeros(0), np.zeros((0, width)), *(np.zeros(0, int) for _ in range(3)))
    lengths = [len(p[0]) for p in parts]
    labels = [np.repeat([p[i] for p in parts], lengths) for i in (2, 3, 4)]
    return Equations(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), *labels)


def windows(track: Track, floor_z: float) -> list[tuple[int, int]]:
    """First and last row of each usable window: rotors settled, clear of the floor and of wakes from
    above."""
    length, first = round(WINDOW / track.dt), round(SETTLE / track.dt)
    clear = np.ones(len(track), bool)
    if track.position is not None:
        clear &= track.position[:, 2] - floor_z > LOWEST
        for other in track.neighbours:
            away = other - track.position
            clear &= ~((away[:, 2] > 0) & (np.hypot(away[:, 0], away[:, 1]) < 0.3))
    starts = range(first, len(track) - length, length)
    return [(s, s + length) for s in starts if clear[s : s + length + 1].all()]


class _Columns:
    """One track's signals, ready to be cut into windows."""

    def __init__(self, track: Track, vehicle, index: dict[str, int], time_constant: float):
        self.track, self.index = track, index
        self.dt = track.dt
        mass, inertia = float(vehicle.mass), np.asarray(vehicle.inertia, float)
        place, spin = np.asarray(vehicle.rotor_position, float), np.asarray(vehicle.rotor_spin, float)
        full = float(vehicle.thrust_constant) * float(vehicle.max_rotor_speed) ** 2
        ratio = float(vehicle.torque_constant / vehicle.thrust_constant)
        mean, at_row = rotor_response(track.motor, time_constant, track.dt)
        torque_of = full * np.stack([place[:, 1], -place[:, 0], ratio * spin]) / inertia[:, None]
        self.angular = mean @ torque_of.T  # (T, 3) rad/s^2 over the row's interval
        self.angular_rate = np.gradient(at_row @ torque_of.T, self.dt, axis=0)
        self.angular_at_row = at_row @ torque_of.T
        self.thrust = full * mean.sum(1) / mass  # (T,) m/s^2
        self.thrust_at_row = full * at_row.sum(1) / mass
        self.lever = self.thrust[:, None] * mass / inertia  # (T, 3) rad/s^2 per metre of lever
        rates = track.body_rates
        self.gyroscopic = -np.cross(rates, inertia * rates) / inertia
        self.flight = track.flight
        if track.velocity is not None and track.quaternion is not None:
            middle = track.quaternion + np.roll(track.quaternion, -1, 0)
            self.turn = rotation(middle / np.linalg.norm(middle, axis=1, keepdims=True))
            self.velocity_middle = 0.5 * (track.velocity + np.roll(track.velocity, -1, 0))

    def window(self, start: int, stop: int):
        """(channel, y, X) of each channel that was logged; channels 0-2 rates, 3-5 velocity, 6 specific
        force."""
        rows, steps = slice(start, stop + 1), slice(start, stop)
        track = self.track
        ramp = np.linspace(-1.0, 1.0, stop - start + 1)
        level_and_slope = np.linalg.qr(np.stack([np.ones_like(ramp), ramp], 1))[0]
        level = np.full((len(ramp), 1), len(ramp) ** -0.5)
        for axis in range(3):
            X = self._zeros(len(ramp))
            X[:, axis] = self._integrated(self.angular[steps, axis])
            X[:, self.index["clock_imu"]] = -self.angular_at_row[rows, axis]
            X[:, self.index[f"offset_{MAIN[axis]}"]] = self._integrated(self.lever[steps, axis])
            X[:, self.index[f"damping_{MAIN[axis]}"]] = -self._integrated(track.body_rates[steps, axis])
            y = track.body_rates[rows, axis] - self._integrated(self.gyroscopic[steps, axis])
            yield axis, *_without(level_and_slope, y, X)
        if hasattr(self, "turn"):
            turn, speed, pull = self.turn[steps], self.velocity_middle[steps], self.thrust[steps]
            along = np.einsum("tij,ti->tj", turn, speed)  # body frame
            lateral = np.einsum("tij,tj->ti", turn[:, :, :2], along[:, :2])
            for axis in range(3):
                X = self._zeros(len(ramp))
                X[:, self._thrust] = self._integrated(turn[:, axis, 2] * pull)
                X[:, self.index["clock_pose"]] = -np.append(
                    turn[:, axis, 2] * pull, turn[-1, axis, 2] * pull[-1]
                )
                for tilt, column in (("tilt_x", 0), ("tilt_y", 1)):
                    X[:, self.index[f"{tilt}:{self.flight}"]] = self._integrated(turn[:, axis, column] * pull)
                X[:, self.index["drag_lateral"]] = -self._integrated(lateral[:, axis])
                X[:, self.index["drag_vertical"]] = -self._integrated(turn[:, axis, 2] * along[:, 2])
                y = track.velocity[rows, axis].copy()
                if axis == 2:
                    y += GRAVITY * self.dt * np.arange(len(y))
                yield 3 + axis, *_without(level if axis == 2 else level_and_slope, y, X)
        if track.specific_force is not None:
            X = self._zeros(len(ramp))
            X[:, self._thrust] = self.thrust_at_row[rows]
            X[:, self.index["clock_imu"]] = -np.gradient(self.thrust_at_row, self.dt)[rows]
            X[:, self.index[f"bias_z:{self.flight}"]] = 1.0
            if hasattr(self, "turn"):
                turn = rotation(track.quaternion[rows])
                X[:, self.index["drag_vertical"]] = -np.einsum(
                    "ti,ti->t", turn[:, :, 2], track.velocity[rows]
                )
            yield 6, track.specific_force[rows, 2].copy(), X

    @property
    def _thrust(self) -> int:
        return self.index.get("thrust", self.index.get(f"thrust:{self.flight}"))

    def _zeros(self, rows: int) -> np.ndarray:
        return np.zeros((rows, len(self.index)))

    def _integrated(self, rate: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(rate) * self.dt])


def rotor_response(motor: np.ndarray, time_constant: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Thrust as a share of the maximal one for commands (T, 4) held for dt s: mean over each row's interval,
    and at its start. The speed follows exactly: T dw/dt = sqrt(m) - w, thrust is its square."""
    target = np.sqrt(np.maximum(motor, 0.0))  # a duty cycle may give more than the nominal vehicle has
    stay = np.exp(-dt / time_constant)
    later = lfilter([1 - stay], [1, -stay], target, axis=0, zi=stay * target[:1])[0]
    speed = np.concatenate([target[:1], later[:-1]])
    away = speed - target
    first, second = time_constant / dt * (1 - stay), time_constant / (2 * dt) * (1 - stay**2)
    return target**2 + 2 * target * away * first + away**2 * second, speed**2


def _without(basis: np.ndarray, y: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return y - basis @ (basis.T @ y), X - basis @ (basis.T @ X)
