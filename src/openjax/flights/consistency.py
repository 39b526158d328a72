"""Do a flight's sensors agree with each other? Finds swapped or reversed axes, wrong quaternion conventions,
wrong units, wrong motor order or spin, from what rigid-body kinematics and the signs of the rotor torques
demand.

Each test compares two signals in a low band, over every relabelling of the axes, and speaks only where the
logged labelling clearly fails and another clearly fits: a flight that doesn't excite an axis isn't blamed
for it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from openjax.flights.flight import Flight, Issue
from openjax.flights.signals import (
    GRAVITY,
    RATE,
    acceleration_of,
    clock_of,
    first_order,
    in_band,
    on_clock,
    rates_of,
    to_body,
    up_of,
)

KINEMATIC_BAND = (0.3, 4.0)  # Hz: above drift and offsets, below most of the sensors' noise and delays
TORQUE_BAND = (0.5, 8.0)
LAGS = np.arange(-6, 7, 2)  # samples of the common clock; clock offsets between streams are a nuisance
LEAST_RATE = 0.03  # rad/s rms in the band, below which an axis can't be judged against the pose
LEAST_COMMANDED = 0.2  # rad/s, the same against commands: in a quiet loop they oppose what the air does
_FITS, _BETTER = 0.65, 0.6  # correlation of an axis that fits; least gain in their sum of another labelling

_AXES = "xyz"
_RELABELLINGS = [
    (order, signs)
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]  # identity first
_QUATERNIONS = {
    "": lambda q: q,
    "in the order x, y, z, w": lambda q: q[:, [3, 0, 1, 2]],
    "from world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
    "in the order x, y, z, w and from world to body": lambda q: q[:, [3, 0, 1, 2]] * [1.0, -1.0, -1.0, -1.0],
}


@dataclass(frozen=True)
class Match:
    """How well `measured` fits `reference` axis by axis: as labelled, and in the best relabelling."""

    as_labelled: np.ndarray  # (3,) correlations
    best: np.ndarray  # (3,) correlations
    order: tuple[int, ...]  # best: measured axis i is reference axis order[i] ...
    signs: tuple[float, ...]  # ... times signs[i]
    gain: float  # rms of measured over rms of reference, over the axes that fit
    excited: np.ndarray  # (3,) whether the axis moves enough to be judged

    @property
    def changed(self) -> np.ndarray:
        """(3,) bool, axes that the best labelling takes from elsewhere or turns round."""
        return np.array(
            [o != i or s < 0 for i, (o, s) in enumerate(zip(self.order, self.signs, strict=True))]
        )

    @property
    def wrong(self) -> bool:
        """The labelling fails on an axis that another labelling explains."""
        clear = self.changed & self.excited & _clearly_better(self.best, self.as_labelled)
        return bool(clear.any() and self.best.sum() - self.as_labelled.sum() > _BETTER)

    @property
    def fits(self) -> bool:
        """The labelling is right, and at least two axes agree well with the reference."""
        return not self.wrong and bool((self.as_labelled > _FITS).sum() >= 2)

    def words(self, names: tuple[str, ...], reference: tuple[str, ...] = ("x", "y", "z")) -> str:
        """Which column holds what: "wx holds the y axis, wy minus the x axis"."""
        parts = []
        for i in np.flatnonzero(self.changed & self.excited & (self.best > _FITS)):
            sign = "minus " if self.signs[i] < 0 else ""
            parts.append(f"{names[i]} holds {sign}{reference[self.order[i]]}")
        return ", ".join(parts)


def check_consistency(flight: Flight, vehicle) -> list[Issue]:
    """Findings on axes, conventions, units and motor order of a flight that has passed the other checks
    (sorted, finite, airborne). `vehicle` gives the rotors' places and spins. Every finding refuses the
    flight."""
    grid = clock_of(flight)
    if grid is None:
        return []
    found: list[tuple[str, str]] = []
    gyro = None if flight.body_rates_derived else on_clock(flight, "body_rates", grid)
    quaternion = on_clock(flight, "quaternion", grid)
    position = on_clock(flight, "position", grid)
    force = on_clock(flight, "specific_force", grid)

    found += _gravity(force)
    if quaternion is not None and not found:
        found += _pose(quaternion, position, gyro, force)
    if position is not None and flight.velocity is not None and not flight.velocity_derived:
        found += _velocity(position, on_clock(flight, "velocity", grid), quaternion)
    rates = gyro if gyro is not None else (None if quaternion is None else rates_of(quaternion))
    if rates is not None and not found:
        if flight.command_body_rates is not None:
            found += _commands(on_clock(flight, "command_body_rates", grid), rates)
        if flight.motor_command is not None and not found:
            found += _motors(on_clock(flight, "motor_command", grid), rates, vehicle)
    return [Issue(flight.name, text, refused=True, kind=kind) for kind, text in found]


def match_axes(measured: np.ndarray, reference: np.ndarray, least: float = 0.0) -> Match:
    """Compare (T, 3) with (T, 3) on the common clock in `band` Hz, over all 48 relabellings and a few
    time shifts."""
    y, x = in_band(measured, KINEMATIC_BAND), in_band(reference, KINEMATIC_BAND)
    correlations = np.stack([_correlation(y, np.roll(x, lag, 0)) for lag in LAGS])  # (L, 3, 3)
    scores = [
        sum(signs[i] * correlations[:, i, order[i]] for i in range(3)).max() for order, signs in _RELABELLINGS
    ]
    order, signs = _RELABELLINGS[int(np.argmax(scores))]
    lag = int(np.argmax(sum(signs[i] * correlations[:, i, order[i]] for i in range(3))))
    best = np.array([signs[i] * correlations[lag, i, order[i]] for i in range(3)])
    as_labelled = correlations[int(np.argmax(np.trace(correlations, axis1=1, axis2=2)))].diagonal()
    fitting = best > _FITS
    rms_y, rms_x = y.std(0), x.std(0)[list(order)]
    gain = (
        float(np.median(rms_y[fitting] / np.maximum(rms_x[fitting], 1e-12)))
        if fitting.any()
        else float("nan")
    )
    # An axis that hardly moves shows the others' leakage and the loop's own noise: too little to accuse it
    # by.
    alike = (rms_y > 0.3 * gain * rms_x) & (rms_y < 3.0 * gain * rms_x)
    return Match(as_labelled, best, order, signs, gain, alike & (rms_x > least) & (rms_y > least))


def _gravity(force: np.ndarray | None) -> list[tuple[str, str]]:
    """A flying quadrotor's specific force points along body z, about 9.81 m/s^2 up, whatever its attitude."""
    if force is None:
        return []
    mean = np.median(force, 0)
    size, axis = float(np.linalg.norm(mean)), int(np.argmax(np.abs(mean)))
    if 0.6 < size < 2.0:
        return [("units", f"ax, ay, az are in g (mean {size:.2f}); the log format wants m/s^2")]
    if 600 < size < 2000:
        return [
            ("units", f"ax, ay, az are in thousandths of g (mean {size:.0f}); the log format wants m/s^2")
        ]
    if size < 0.6:
        text = "az is near zero in flight: gravity was taken out"
        return [("units", f"{text}; the log format wants specific force, +9.81 m/s^2 on z at hover")]
    if not 4.0 < size < 30.0:
        return [
            ("units", f"the mean specific force is {size:.3g}, not near 9.81 m/s^2: wrong unit or corrupt")
        ]
    if axis != 2 and abs(mean[axis]) > 2 * abs(mean[2]):
        sign = "minus " if mean[axis] < 0 else ""
        return [("axes", f"accelerometer axes: a{_AXES[axis]} holds {sign}z (median {mean[axis]:.1f} m/s^2)")]
    if mean[2] < 0:
        return [
            ("axes", f"accelerometer sign: az is {mean[2]:.1f} m/s^2 in flight; it must read +9.81 at hover")
        ]
    return []


def _pose(quaternion, position, gyro, force) -> list[tuple[str, str]]:
    """Attitude against gyroscope and against the curvature of the path: first which convention fits both."""
    matches = {}
    for name, convert in _QUATERNIONS.items():
        attitude = convert(quaternion)
        pair = []
        if gyro is not None:
            pair.append(match_axes(gyro, rates_of(attitude), LEAST_RATE))
        if position is not None:
            pair.append(match_axes(acceleration_of(position), _path_acceleration(attitude, force)))
        matches[name] = pair
    logged = matches[""]
    if any(m.wrong for m in logged):
        for name, pair in matches.items():
            if name and all(m.fits for m in pair):
                return [
                    (
                        "quaternion",
                        f"the quaternion is {name}; the log format wants w, x, y, z from body to world",
                    )
                ]
        found = []
        if gyro is not None and logged[0].wrong:
            found.append(("axes", f"gyroscope axes: {logged[0].words(('wx', 'wy', 'wz'))} of the pose"))
        elif position is not None and logged[-1].wrong:
            found.append(
                ("axes", f"position axes: {logged[-1].words(('x', 'y', 'z'))} of the attitude's world")
            )
        return found
    found = []
    if gyro is not None:
        found += _scale(logged[0].gain, "wx, wy, wz", "deg/s", "rad/s", 180 / np.pi, "the quaternion's rate")
    if position is not None:
        for unit, factor in (("mm", 1000.0), ("cm", 100.0)):
            found = found or _scale(
                logged[-1].gain, "x, y, z", unit, "m", factor, "what the accelerations say"
            )
    return found


def _velocity(position, velocity, quaternion) -> list[tuple[str, str]]:
    derived = np.gradient(position, 1 / RATE, axis=0)
    match = match_axes(velocity, derived)
    if match.wrong and quaternion is not None and match_axes(velocity, to_body(quaternion, derived)).fits:
        return [("axes", "vx, vy, vz are in the body frame; the log format wants the world frame")]
    if match.wrong:
        return [("axes", f"velocity axes: {match.words(('vx', 'vy', 'vz'))} of the position's derivative")]
    found = _scale(match.gain, "vx, vy, vz", "mm/s", "m/s", 1000.0, "the position's derivative")
    return found or _scale(1 / match.gain, "x, y, z", "mm", "m", 1000.0, "the velocity's integral")


def _commands(command, rates) -> list[tuple[str, str]]:
    """Commanded body rates against the measured ones: the rate loop follows in this band."""
    match = match_axes(command, rates, LEAST_COMMANDED)
    names = ("cmd_wx", "cmd_wy", "cmd_wz")
    if match.wrong:
        return [("axes", f"command axes: {match.words(names)} of the gyroscope")]
    found = _scale(match.gain, ", ".join(names), "deg/s", "rad/s", 180 / np.pi, "the gyroscope")
    return found or _scale(1 / match.gain, "wx, wy, wz", "deg/s", "rad/s", 180 / np.pi, "the commanded rates")


def _motors(motor, rates, vehicle) -> list[tuple[str, str]]:
    """Angular acceleration against what the motors' torques demand, over all 24 orders and both spins."""
    place = np.asarray(vehicle.rotor_position, float)
    arms = np.stack([place[:, 1], -place[:, 0]])  # roll, pitch torque per thrust
    spin = np.asarray(vehicle.rotor_spin, float)
    measured = in_band(np.gradient(rates, 1 / RATE, axis=0), TORQUE_BAND)
    lagged = in_band(first_order(motor, float(vehicle.motor_time_constant)), TORQUE_BAND)
    if (lagged.std(0) < 1e-6).all():
        return []
    # (3, 4) correlations of each axis with each motor aren't enough: motors are correlated. Score whole
    # torques, out of the moments of angular acceleration and motors at each clock offset.
    shifted = np.stack([np.roll(lagged, lag, 0) for lag in LAGS])
    cross = np.einsum("ti,ltj->lij", measured, shifted)
    among = np.einsum("lti,ltj->lij", shifted, shifted)
    size = np.sqrt((measured**2).sum(0))
    best, best_score, logged = None, -np.inf, None
    for order in itertools.permutations(range(4)):
        for flip in (1.0, -1.0):
            mixing = np.stack([arms[0][list(order)], arms[1][list(order)], flip * spin[list(order)]])
            power = np.einsum("ij,ljk,ik->li", mixing, among, mixing)
            each = (mixing * cross).sum(2) / np.maximum(np.sqrt(np.maximum(power, 0.0)) * size, 1e-12)
            correlations = each[int(np.argmax(each.sum(1)))]
            if logged is None:
                logged = correlations
            if correlations.sum() > best_score + 1e-9:
                best, best_score = (order, flip, correlations), correlations.sum()
    order, flip, correlations = best
    # The right order explains every axis; an offset mass or weak motor can spoil one or two, and isn't an
    # order.
    explains = correlations.min() > 0.4 and correlations.mean() > _FITS
    if not explains or not _clearly_better(correlations, logged).any() or best_score - logged.sum() < _BETTER:
        return []
    if order == (0, 1, 2, 3):
        text = "the rotors' spin is opposite: yaw accelerates against the torque of m1..m4"
        return [("motors", f"{text}; reverse motor.spin in vehicle.toml")]
    names = ("front_right", "rear_right", "rear_left", "front_left")
    words = ", ".join(f"m{i + 1} {names[o]}" for i, o in enumerate(order))
    words += " with the spins reversed" if flip < 0 else ""
    text = f"motor order: the angular acceleration fits only if (in the nominal order) {words}"
    return [("motors", f"{text}; correct motor.order in vehicle.toml")]


def _scale(
    gain: float, columns: str, unit: str, wanted: str, factor: float, against: str
) -> list[tuple[str, str]]:
    if not factor / 2.5 < gain < factor * 2.5:
        return []
    return [("units", f"{columns} are in {unit} ({gain:.0f} x {against}); the log format wants {wanted}")]


def _path_acceleration(quaternion, force) -> np.ndarray:
    """Acceleration (T, 3) m/s^2, world, of a vehicle whose specific force lies along body z."""
    size = np.full(len(quaternion), GRAVITY) if force is None else force[:, 2]
    return up_of(quaternion) * size[:, None] - [0.0, 0.0, GRAVITY]


def _correlation(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (y.T @ x) / np.maximum(np.outer(np.linalg.norm(y, axis=0), np.linalg.norm(x, axis=0)), 1e-12)


def _clearly_better(best: np.ndarray, as_labelled: np.ndarray) -> np.ndarray:
    """Per axis: another labelling fits and the logged one fails, the less the better the other fits."""
    fails = (as_labelled < 0.3) | (best > as_labelled + 0.8) | ((best > 0.9) & (as_labelled < 0.6))
    return (best > _FITS) & fails
