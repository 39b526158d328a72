"""The attitude where none was logged, from gyroscope, accelerometer and path.

What the accelerometer feels, turned into the world, is the path's acceleration and gravity. The
gyroscope says how the body turned meanwhile, so one rotation of each flight is free (Wahba's
problem, solved by Kabsch 1976), and a slow error of the gyroscope: a linear spline, fitted by
Gauss-Newton steps. No dynamics are assumed: what acts on the vehicle is left as it is.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.flights.flight import Flight
from openjax.flights.track import GRAVITY

STEP = 0.01  # s of the clock on which rates are integrated
WINDOW = 0.2  # s over which the path's acceleration is a change of velocity
# s from which the first rotation is taken: a gyroscope hardly drifts meanwhile
START = 8.0
KNOTS = 1.0  # s between knots of the gyroscope's slow error
WANDER = 0.03  # rad by which integrated rates drift in a second: bias, gain and noise
FELT = 0.3  # m/s^2 by which a window's mean force and acceleration may differ
BIAS = 0.3  # m/s^2 of an accelerometer
STEPS = 6
FEWEST = 10  # windows


def derive_attitude(flight: Flight, note) -> Flight:
    """The flight with an attitude where none was logged, but what tells one."""
    if flight.quaternion is not None or flight.velocity is None or not flight.has_imu:
        return flight
    if flight.body_rates_derived:
        return flight
    stretches = flight.stretches(max_step=max(0.05, 3 * flight.row_period))
    quaternion = np.full((len(flight), 4), np.nan)
    for rows in stretches:
        part = flight.rows(rows)
        if part.duration > FEWEST * WINDOW:
            quaternion[rows] = _attitude(part)
    if np.isnan(quaternion).all():
        return flight
    note("columns", "no attitude was logged: it is derived from gyroscope, accelerometer and path")
    return dataclasses.replace(flight, quaternion=quaternion, attitude_derived=True)


def _attitude(part: Flight) -> np.ndarray:
    """Quaternions (T, 4) of a stretch without gaps."""
    time = np.arange(part.time[0], part.time[-1], STEP)
    rates = part.interpolated("body_rates", time)
    force = part.interpolated("specific_force", time)
    velocity = part.interpolated("velocity", time)
    size = round(WINDOW / STEP)
    windows = len(time) // size - 1
    ends = size * np.arange(windows + 1)
    # an accelerometer feels what holds the vehicle against gravity, as if it accelerated upwards
    velocity_force = np.diff(velocity[ends], axis=0) / WINDOW + [0.0, 0.0, GRAVITY]
    rotation = _integrate(rates)
    beginning = slice(0, max(int(START / WINDOW), FEWEST))
    measured_force = _means(rotation.apply(force), ends)
    attitude = _kabsch(measured_force[beginning], velocity_force[beginning]) * rotation
    middle = time[ends[:-1]] + 0.5 * WINDOW - time[0]
    knots = max(int(np.ceil((time[-1] - time[0]) / KNOTS)) + 1, 2)
    weights = _hats(middle, knots)
    bias = np.zeros(3)
    total = np.zeros((knots, 3))
    for _ in range(STEPS):
        push, drift = _step(attitude, force - bias, (ends, velocity_force, weights), total)
        bias = bias + push
        total = total + drift
        attitude = Rotation.from_rotvec(_hats(time - time[0], knots) @ drift) * attitude
        if np.abs(drift).max() < 1e-4:
            break
    # without jumps between q and -q, so that rows between may be interpolated
    quaternion = attitude.as_quat(scalar_first=True)
    quaternion[1:] *= np.cumprod(
        np.where((quaternion[1:] * quaternion[:-1]).sum(1) < 0.0, -1.0, 1.0)
    )[:, None]
    at = np.clip(part.time, time[0], time[-1])
    out = np.stack([np.interp(at, time, column) for column in quaternion.T], 1)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _step(attitude: Rotation, force: np.ndarray, windows, total: np.ndarray):
    """One Gauss-Newton step: change (3,) of the accelerometer's bias, and (knots, 3)
    rad by which the attitude turns in the world. `windows`: ends, wanted forces (W, 3)
    and weights (W, knots) of the knots; `total` (knots, 3): turned so far.
    """
    ends, velocity_force, weights = windows
    measured_force = _means(attitude.apply(force), ends)
    residual = (velocity_force - measured_force) / FELT
    turn = _means(attitude.as_matrix().reshape(-1, 9), ends).reshape(-1, 3, 3)
    knots = weights.shape[1]
    by_bias = -turn / FELT
    # (W, 3, 3)
    by_turn = np.stack([np.cross(axis, measured_force) for axis in np.eye(3)], 2) / FELT
    columns = np.einsum("wk,wij->wikj", weights, by_turn).reshape(len(measured_force), 3, 3 * knots)
    columns = np.concatenate([by_bias, columns], 2).reshape(-1, 3 + 3 * knots)
    # The gyroscope's error walks at random from knot to knot.
    walk = np.kron(np.diff(np.eye(knots), axis=0), np.eye(3)) / WANDER
    prior = np.concatenate([np.zeros((len(walk), 3)), walk], 1)
    rows = np.concatenate([columns, prior, np.eye(3, 3 + 3 * knots) / BIAS])
    target = np.concatenate([residual.ravel(), -walk @ total.ravel(), np.zeros(3)])
    solution = np.linalg.lstsq(rows, target, rcond=1e-9)[0]
    return solution[:3], solution[3:].reshape(knots, 3)


def _integrate(rates: np.ndarray) -> Rotation:
    """Attitudes of a body that turns with rates (T, 3) rad/s, from no rotation on."""
    turns = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * STEP).as_quat()
    quaternion = np.zeros((len(rates), 4))
    quaternion[0, 3] = 1.0
    for row, (x, y, z, w) in enumerate(turns):
        a, b, c, d = quaternion[row]
        quaternion[row + 1] = (
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        )
    return Rotation.from_quat(quaternion)


def _kabsch(vectors: np.ndarray, targets: np.ndarray) -> Rotation:
    """The rotation that turns vectors (W, 3) into wanted ones best."""
    return Rotation.align_vectors(targets, vectors)[0]


def _means(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Means (W, C) of rows (T, C) between ends (W + 1,), by the trapezoidal rule."""
    middle = 0.5 * (values[1:] + values[:-1])
    return np.add.reduceat(middle[: ends[-1]], ends[:-1], axis=0) / np.diff(ends)[:, None]


def _hats(time: np.ndarray, knots: int) -> np.ndarray:
    """Weights (T, knots) of a linear spline at times from its start on, s."""
    return np.maximum(1.0 - np.abs(time[:, None] / KNOTS - np.arange(knots)), 0.0)
