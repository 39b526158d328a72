"""Replay of the motion: what a vehicle with given effects would have measured along each track, channel by
channel.

Channels: body rates (3), velocity (3, world) - both integrated from the first row - and specific force (3,
body). Residuals are compared through noise models (`whitening`), with the nuisances marginalised per
flight."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from scipy.linalg import solve_triangular

from openjax.flights.track import Track, rotation, smooth
from openjax.gap.library import ABSENT, MOTOR_SHIFT, NUISANCES, PHYSICS_EFFECTS, PLACE, STEP, THETA
from openjax.gap.physics import Path, compiled_physics
from openjax.gap.whitening import Noise, first_noise, whiten
from openjax.vehicle.effects.airspeed import PROPELLER_RADIUS
from openjax.vehicle.effects.effect import ARENA_CEILING

RATES, VELOCITY, FORCE = slice(0, 3), slice(3, 6), slice(6, 9)
# Groups of channels that share a noise model: axes, whether integrated.
GROUPS = (((0, 1), True), ((2,), True), ((3, 4), True), ((5,), True), ((6, 7), False), ((8,), False))
FIRST_NOISE = (0.03, 0.03, 0.006, 0.006, 0.25, 0.25)
TRIM = 0.5  # s: what motors do more slowly is no answer to a gust, but what the vehicle needs
SKIP = 0.2  # s left out at the start of a track: rotor speeds are not known there
BUCKETS = (256, 512, 1024, 2048, 4096, 8192, 16384, 32768)
BATCH = 8
# Nuisances and their standard deviations, free in every hypothesis.
TILT = np.radians(0.5)  # between tracked frame and thrust axis
LEVEL = np.radians(0.15)  # of motion capture's world
IMU_TILT = 0.01  # rad, between the IMU's axes and the body's
GYROSCOPIC = 0.1  # relative to the moments of inertia
DAMPING = 0.15  # 1/s, of the body rates by what the rotors do
APART = 0.03  # s, the same of motor commands whose stream isn't on the pose's clock
ACCELEROMETER_BIAS = 0.2  # m/s^2: zero-g offset of a BMI088, 20 mg
ACCELEROMETER_LAG = 0.004  # s, of a low-pass before the log: 30 Hz in the firmware of the Crazyflie
GYROSCOPE_LAG = 0.0015  # s, likewise: 80 Hz
POSE_SHIFT = 0.0015  # s between motion capture and the vehicle's clock
FEEDBACK = 1.0  # of the strength of what feedback makes of the motor commands, at each of
FEEDBACK_ROWS = (0, 2)  # rows of delay
QUICK_ROWS = (0, 1, 2)
# Nuisances that belong to a track, not to the vehicle.
OF_A_TRACK = ("clock of the motors", "accelerometer bias", "clock of the pose")
WAKE_TORQUE = 5.0  # rad/s^2 at the edge of another vehicle's wake, which no simple form of it has right
WAKE_WIDTHS = (0.05, 0.1)  # m
NEAR_TORQUE = 500.0  # 1/s^2 per rad of tilt a propeller's radius from floor or ceiling: what half of a usual ground effect does
NEAR_OFFSET = 0.02  # m


def bucket(length: int) -> int:
    """The padded length of a track: a few fixed sizes, so that nothing is compiled twice."""
    return next((b for b in BUCKETS if b >= length), length)


def padded(values: np.ndarray, length: int) -> np.ndarray:
    """float32, the last row repeated up to `length`."""
    values = np.asarray(values, np.float32)
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), 0)])


@dataclass(eq=False)
class Replay:
    """All tracks of a case under one nominal vehicle each. `usable` (9,) says which channels were logged."""

    tracks: list[Track]
    vehicles: list
    paths: list[Path]
    measured: list[np.ndarray]  # (T, 9)
    nominal: list[np.ndarray]  # (T, 9)
    nuisances: list[np.ndarray]  # (N, T, 9), in units of their standard deviations
    flights: tuple[str, ...]
    flight_of: np.ndarray  # (tracks,) index of a track's flight
    usable: np.ndarray
    noises: tuple[Noise, ...] = ()
    whitened_nuisances: list | None = None
    projections: list | None = None  # (N, M) per track: whitened nuisances times (1 + n n')^(-1/2)
    numbers: tuple = NUISANCES  # the vehicle's numbers among the nuisances, which come first
    nuisance_names: tuple[str, ...] = ()
    gusts: np.ndarray | None = (
        None  # (3,) their share in the torques about each axis, see `feedback.gustiness`
    )
    shared: np.ndarray | None = (
        None  # (N,) whether a nuisance belongs to the vehicle (all flights) or to a track
    )

    def predict(self, theta: np.ndarray, track: int | None = None) -> list[np.ndarray]:
        """Channels (B, T, 9) of each track (or of one) for parameter vectors theta (B, P)."""
        count = len(theta)
        fill = -count % BATCH
        theta = np.concatenate([theta, np.repeat(theta[:1], fill, 0)]).astype(np.float32)
        physics = compiled_physics(PHYSICS_EFFECTS, THETA)
        numbers = range(len(self.tracks)) if track is None else (track,)
        # All of it is under way before any of it is waited for.
        running = [
            [
                physics(theta[i : i + BATCH], self.vehicles[n], self.paths[n])
                for i in range(0, len(theta), BATCH)
            ]
            for n in numbers
        ]
        return [
            _integrated(np.concatenate(parts)[:count, : len(self.tracks[n])], self.tracks[n].dt)
            for n, parts in zip(numbers, running, strict=True)
        ]

    def set_noise(self, noises) -> None:
        """Use these noise models; unlogged channels get none and count nothing."""
        self.noises = tuple(noises)
        self.whitened_nuisances = [self.whiten(n, k) for k, n in enumerate(self.nuisances)]
        self.projections = [projection(n.reshape(len(n), -1)) for n in self.whitened_nuisances]

    def loosen(self, usual: dict[str, float]) -> None:
        """Let nuisances be `usual` {name: times} as large as they usually are."""
        times = np.array([usual.get(n, 1.0) for n in self.nuisance_names])
        self.nuisances = [n * times[:, None, None] for n in self.nuisances]
        self.set_noise(self.noises)

    def whiten(self, x: np.ndarray, track: int) -> np.ndarray:
        """x (..., T, 9) of a track -> (..., T', 9) in units of the noise, without the first moments."""
        out = whiten(self.noises, x) * self.usable
        return out[..., int(SKIP / self.tracks[track].dt) :, :]

    def grams(self, columns: list[np.ndarray]) -> np.ndarray:
        """Inner products (F, C, C) per flight of columns [(C, T, 9) per track], nuisances marginalised."""
        size = len(columns[0])
        total = np.zeros((len(self.flights), size, size))
        for number, column in enumerate(columns):
            w = self.whiten(column, number).reshape(size, -1)
            cross = w @ self.projections[number].T
            total[self.flight_of[number]] += w @ w.T - cross @ cross.T
        return total

    def linearised(self, theta: np.ndarray, index: np.ndarray) -> list[np.ndarray]:
        """Residual and derivatives (1 + p, T, 9) of each track at theta (P,) with respect to theta[index]."""
        index = np.asarray(index, int)
        batch = np.repeat(theta[None], len(index) + 1, 0)
        batch[np.arange(len(index)) + 1, index] += STEP[index]
        steps = STEP[index][:, None, None]
        return [
            np.concatenate([(y - p[0])[None], (p[1:] - p[:1]) / steps])
            for y, p in zip(self.measured, self.predict(batch), strict=True)
        ]


def projection(nuisances: np.ndarray) -> np.ndarray:
    """(N, M) rows p such that w w' - (w p')(w p')' is the gram of w (C, M) once nuisances (N, M) of unit prior
    variance are marginalised."""
    root = np.linalg.cholesky(np.eye(len(nuisances)) + nuisances @ nuisances.T)
    return solve_triangular(root, nuisances, lower=True, check_finite=False)


def marginal_gram(w: np.ndarray, nuisances: np.ndarray) -> np.ndarray:
    """w w' (C, C) of whitened columns (C, M), nuisances (N, ...) of unit prior variance marginalised."""
    n = nuisances.reshape(len(nuisances), -1)
    cross = w @ n.T
    return w @ w.T - cross @ np.linalg.solve(np.eye(len(n)) + n @ n.T, cross.T)


def _integrated(rows: np.ndarray, dt: float) -> np.ndarray:
    """Channels (B, T, 9) from accelerations and specific force (B, T, 9) of the rows' intervals."""
    rows = rows.astype(float)
    integral = np.zeros_like(rows[:, :, :6])
    np.cumsum(rows[:, :-1, :6] * dt, axis=1, out=integral[:, 1:])
    specific = rows[:, :, 6:].copy()
    specific[:, 1:] = 0.5 * (rows[:, 1:, 6:] + rows[:, :-1, 6:])
    return np.concatenate([integral, specific], 2)


def make_replay(
    tracks, vehicles, motor_ticks, feedback, numbers=NUISANCES, one_clock=True, at_once=False, wander=0.0
) -> Replay:
    """Replay of tracks with their nominal vehicles and motor commands (T, TICKS, 4) of the rate loop's ticks. `feedback` of
    each track: what it made of the motors may be anything in strength and lag. `at_once`: motor commands are single
    samples, whose quick part and time within a row aren't known. `wander` s: by how much clocks drift. Without `one_clock`
    the IMU's stream and the motors' are apart by unknown times: the IMU counts nothing, and the motors may be off by
    tens of milliseconds."""
    paths = [jax.device_put(_path(t, m)) for t, m in zip(tracks, motor_ticks, strict=True)]
    measured = [_measured(t) for t in tracks]
    usable = np.ones(9)
    if any(t.velocity is None for t in tracks):
        usable[VELOCITY] = 0.0
    if any(t.specific_force is None for t in tracks):
        usable[FORCE] = 0.0
    if not one_clock and usable[3]:
        usable[RATES] = usable[FORCE] = 0.0
    if usable[3:].any() and not all(t.motors_logged for t in tracks):
        usable[RATES] = 0.0  # motors made from commands tell the thrust, not how a real loop shares it out
    flights = tuple(dict.fromkeys(t.flight for t in tracks))
    replay = Replay(
        list(tracks),
        [jax.device_put(jax.tree.map(np.float32, v)) for v in vehicles],
        paths,
        measured,
        [],
        [],
        flights,
        np.array([flights.index(t.flight) for t in tracks]),
        usable,
        numbers=numbers,
    )
    index = [PLACE[key[:2]] for key in numbers] + [len(ABSENT) - 1]
    shift = (
        max(MOTOR_SHIFT, wander + (tracks[0].dt / 4 if at_once or wander else 0.0)) if one_clock else APART
    )
    batch = np.repeat(ABSENT[None], 1 + len(index), 0)
    batch[np.arange(len(index)) + 1, index] += STEP[index]
    named = []
    for number, track in enumerate(tracks):
        base, *moved = replay.predict(batch, number)[0]
        replay.nominal.append(base)
        columns = {
            " ".join(key[:2]): (m - base) * key[2] / STEP[k]
            for key, m, k in zip(numbers, moved, index, strict=False)
        }
        for name in columns:
            if name.startswith("inertia "):
                _without_trim(columns[name], track)
        columns["clock of the motors"] = (moved[-1] - base) * shift / STEP[-1]
        columns |= _late_torques("feedback", track, feedback[number].acceleration, FEEDBACK_ROWS)
        if at_once:
            columns |= _late_torques("motors within a row", track, feedback[number].quick, QUICK_ROWS)
        columns |= _sensor_nuisances(track, paths[number], base, max(POSE_SHIFT, wander))
        columns |= _wake_torques(track) | _near_torques(track)
        named.append(columns)
    # A track without a neighbour has no wake: nothing there.
    names = tuple(max(named, key=len))
    for columns, base in zip(named, replay.nominal, strict=True):
        replay.nuisances.append(np.stack([columns.get(n, np.zeros_like(base)) for n in names]))
    replay.nuisance_names = names
    replay.shared = np.array([not n.startswith(OF_A_TRACK) for n in names])
    replay.set_noise([first_noise(a, i, d) for (a, i), d in zip(GROUPS, FIRST_NOISE, strict=True)])
    return replay


def _path(track: Track, ticks: np.ndarray) -> Path:
    rows, size = len(track), bucket(len(track))

    def middle(values):
        return padded(0.5 * (values + np.concatenate([values[1:], values[-1:]])), size)

    unknown = np.zeros((rows, 3))
    quaternion = track.quaternion if track.quaternion is not None else np.tile([1.0, 0, 0, 0], (rows, 1))
    quaternion = middle(quaternion)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    # Without a pose the vehicle is taken to be in mid-air, far from everything.
    position = track.position if track.position is not None else unknown + np.array([0.0, 0.0, 0.6])
    # Neither floor nor ceiling can be entered: a log that says so has an offset in height.
    position = np.concatenate([position[:, :2], np.clip(position[:, 2:], 0.0, ARENA_CEILING)], 1)
    velocity = track.velocity if track.velocity is not None else unknown
    others = [middle(p) for p in track.neighbours] or [np.tile(np.float32([50.0, 50.0, -50.0]), (size, 1))]
    voltage = np.full(size, np.nan, np.float32) if track.voltage is None else middle(track.voltage)
    return Path(
        middle(position),
        quaternion,
        middle(velocity),
        middle(smooth(track.body_rates, 0.05, track.dt)),
        padded(ticks, size),
        voltage,
        np.stack(others, 1),
        np.float32(track.dt),
    )


def _measured(track: Track) -> np.ndarray:
    out = np.zeros((len(track), 9))
    out[:, RATES] = track.body_rates - track.body_rates[0]
    if track.velocity is not None:
        out[:, VELOCITY] = track.velocity - track.velocity[0]
    if track.specific_force is not None:
        out[:, FORCE] = track.specific_force
    return out


def _sensor_nuisances(
    track: Track, path: Path, nominal: np.ndarray, pose_shift: float
) -> dict[str, np.ndarray]:
    """Mounting, biases and clocks of the sensors, and what a rigid body with small errors does: columns (T, 9)."""
    rows = len(track)
    turn = rotation(np.asarray(path.quaternion, float)[:rows])
    specific = np.gradient(nominal[:, VELOCITY], track.dt, axis=0) + np.array([0.0, 0.0, 9.81])
    body = np.einsum("tji,tj->ti", turn, specific)
    columns: dict[str, np.ndarray] = {}

    def column(name: str, channel, values, size: float) -> None:
        out = np.zeros((rows, 9))
        out[:, channel] = values
        columns[name] = columns.get(name, 0.0) + out * size

    def moved(acceleration):  # what a change of the body-frame acceleration does to the velocity
        return np.cumsum(np.einsum("tij,tj->ti", turn, acceleration), 0) * track.dt

    rates = smooth(track.body_rates, 0.03, track.dt)
    force = nominal[:, FORCE]
    for name, axis in zip("xy", np.eye(3), strict=False):
        column(f"frame tilt {name}", VELOCITY, moved(np.cross(axis, body)), TILT)
    for number, name in enumerate("xyz"):
        column(f"accelerometer bias {name}", 6 + number, 1.0, ACCELEROMETER_BIAS)
    for name, axis in zip("xyz", np.eye(3), strict=True):
        column(f"IMU tilt {name}", RATES, -np.cross(axis, rates - rates[0]), IMU_TILT)
        column(f"IMU tilt {name}", FORCE, -np.cross(axis, force), IMU_TILT)
    for axis, name in enumerate("xyz"):
        turning = np.cumsum(rates[:, axis - 2] * rates[:, axis - 1]) * track.dt
        column(f"gyroscopic torque {name}", axis, turning, GYROSCOPIC)
    for name, axes in (("roll and pitch damping", (0, 1)), ("yaw damping", (2,))):
        column(name, axes, -np.cumsum(rates, 0)[:, axes] * track.dt, DAMPING)
    for axis, name in enumerate("xy"):
        column(f"level of the world {name}", 3 + axis, 9.81 * track.dt * np.arange(rows), LEVEL)
    column("accelerometer's low-pass", FORCE, -np.gradient(force, track.dt, axis=0), ACCELEROMETER_LAG)
    spinning = np.gradient(nominal[:, RATES], track.dt, axis=0)
    column("gyroscope's low-pass", RATES, -(spinning - spinning[0]), GYROSCOPE_LAG)
    if track.velocity is not None:
        late = -moved(np.cross(np.asarray(path.body_rates, float)[:rows], body))
        late += smooth(np.gradient(track.velocity, track.dt, axis=0), 0.05, track.dt)
        column("clock of the pose", VELOCITY, late, pose_shift)
    return columns


def _without_trim(column: np.ndarray, track: Track) -> None:
    """Take the slow part off the torques of a column (T, 9). Motors that hold a trim hold it against something, and the two
    together turn a heavier body no less: inertia must not take what an offset or a weak rotor does."""
    turning = np.diff(column[:, RATES], axis=0, prepend=column[:1, RATES])
    column[:, RATES] = np.cumsum(turning - smooth(turning, TRIM, track.dt), 0)


def _late_torques(name: str, track: Track, acceleration: np.ndarray, delays) -> dict[str, np.ndarray]:
    """Columns (T, 9) of angular accelerations by roll and pitch, yaw, at some delays: a filter of any shape."""
    columns = {}
    for rows in delays:
        late = np.concatenate([np.zeros((rows, 3)), acceleration[: len(acceleration) - rows]])
        for axes, mask in (("roll and pitch", [1.0, 1.0, 0.0]), ("yaw", [0.0, 0.0, 1.0])):
            columns[f"{name}, {axes}, {rows} rows late"] = torque_channels(late * mask, track.dt) * FEEDBACK
    return columns


def torque_channels(acceleration: np.ndarray, dt: float) -> np.ndarray:
    """Channels (T, 9) of an angular acceleration (T, 3)."""
    column = np.zeros((len(acceleration), 9))
    column[1:, RATES] = np.cumsum(acceleration[:-1], 0) * dt
    return column


def _near_torques(track: Track) -> dict[str, np.ndarray]:
    """How floor and ceiling right a tilted vehicle or turn it over, which depends on more than its height: columns (T, 9)."""
    if track.position is None or track.quaternion is None:
        return {}
    height, up = track.position[:, 2], rotation(track.quaternion)[:, 2]
    tilt = np.stack([-up[:, 1], up[:, 0], np.zeros(len(track))], 1)
    out = {}
    for name, distance in (("floor", height), ("ceiling", ARENA_CEILING - height)):
        near = (PROPELLER_RADIUS / (np.maximum(distance, 0.0) + NEAR_OFFSET)) ** 3
        out[f"torque near the {name}"] = torque_channels(tilt * near[:, None], track.dt) * NEAR_TORQUE
    return out


def _wake_torques(track: Track) -> dict[str, np.ndarray]:
    """How the wakes of vehicles above turn this one, by wake width: columns (T, 9)."""
    if track.position is None or not len(track.neighbours) or track.quaternion is None:
        return {}
    gap = track.neighbours - track.position
    height = np.maximum(gap[..., 2:], 0.0)
    square = (gap[..., :2] ** 2).sum(-1, keepdims=True)
    out = {}
    for width in WAKE_WIDTHS:
        strength = (gap[..., 2:] > 0.02) * np.exp(-height / 0.5 - square / (2.0 * width**2)) / width
        # The side nearer to the wake is pushed down: (gap) x (-e_z).
        world = np.stack([-gap[..., 1], gap[..., 0], np.zeros_like(gap[..., 0])], -1) * strength
        turned = np.einsum("tji,tj->ti", rotation(track.quaternion), world.sum(0))
        out[f"wake, {width:g} m"] = torque_channels(turned, track.dt) * WAKE_TORQUE
    return out
