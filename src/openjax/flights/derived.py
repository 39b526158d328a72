"""Quantities that a log leaves out: velocities from positions, body rates from attitudes."""

import dataclasses

import numpy as np

from openjax.flights.flight import Flight, Refused

# rad/s of body rates that are derived: what gyroscopes of such vehicles have at most
RATE_NOISE = 0.04
# of a velocity that a gap has spoilt:
BESIDE_GAP = 4  # rows beside it in which that shows
GAP = 1.5  # usual steps, from which rows are missing
OUTSIDE = 6.0  # standard deviations by which it is off


def derive_velocity(flight: Flight, note) -> Flight:
    """Velocity from position where it wasn't logged: local quadratic fits over about 50
    ms (Savitzky-Golay).
    """
    if flight.velocity is not None or flight.position is None:
        return flight
    time, position = flight.sampled("position")
    half = max(2, round(0.025 / max(float(np.median(np.diff(time))), 1e-4)))
    velocity = np.full((len(flight), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(flight.position).all(1))
    if len(rows) < 2 * half + 1:
        raise Refused("short", f"only {len(rows)} rows hold a position")
    velocity[rows], reach = _slopes(time, position, half)
    jump = reach > 0.25
    velocity[rows[jump]] = np.nan
    note("columns", "no velocity was logged: it is derived from position")
    return dataclasses.replace(flight, velocity=velocity, velocity_derived=True)


def mend_velocity(flight: Flight, note) -> Flight:
    """A velocity that somebody differentiated row by row is wrong beside rows that are missing:
    there it is taken from the position, where it is far off its slope for such rows alone.
    """
    if flight.velocity is None or flight.position is None:
        return flight
    rows = np.flatnonzero(np.isfinite(flight.position).all(1) & np.isfinite(flight.velocity).all(1))
    if len(rows) < 10 * BESIDE_GAP:
        return flight
    time = flight.time[rows]
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > GAP * np.median(steps))
    beside = np.zeros(len(rows), bool)
    for shift in range(-BESIDE_GAP, BESIDE_GAP):
        beside[np.clip(gaps + 1 + shift, 0, len(rows) - 1)] = True
    if not beside.any() or beside.mean() > 0.5:
        return flight
    slope, reach = _slopes(time, flight.position[rows], BESIDE_GAP - 1)
    off = flight.velocity[rows] - slope
    # by which a median becomes a standard deviation, and outliers don't count
    usual = 1.4826 * np.median(np.abs(off[~beside]), axis=0) + 1e-6
    wrong = beside & (np.abs(off) > OUTSIDE * usual).any(1) & (reach < 0.25)
    if not wrong.any():
        return flight
    velocity = flight.velocity.copy()
    velocity[rows[wrong]] = slope[wrong]
    note(
        "gaps",
        f"velocity in {wrong.sum()} rows beside missing ones contradicts the position: taken from "
        "it there",
    )
    return dataclasses.replace(flight, velocity=velocity)


def _slopes(time: np.ndarray, values: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (R, C) of values (R, C) by local quadratic fits over 2 `half` + 1 rows
    (Savitzky-Golay, for uneven steps too), and how far in time (R,) each fit reaches.
    """
    index = np.clip(np.arange(len(time)), half, len(time) - half - 1)[:, None] + np.arange(
        -half, half + 1
    )
    dt = time[index] - time[:, None]
    basis = np.stack([np.ones_like(dt), dt, dt**2], -1)
    normal = np.einsum("rki,rkj->rij", basis, basis)
    moment = np.einsum("rki,rkc->ric", basis, values[index])
    scale = np.array([1.0, 1e-2, 1e-4])  # keeps the normal equations well conditioned
    lines = np.linalg.solve(normal / np.outer(scale, scale), moment / scale[:, None])
    return lines[:, 1] / scale[1], np.abs(dt).max(1)


def derive_rates(flight: Flight, note) -> Flight:
    """Body rates from the attitude where no gyroscope was logged: w = 2 (q* dq/dt),
    local quadratic fits.
    """
    if flight.body_rates is not None or flight.quaternion is None:
        return flight
    time, attitude = flight.sampled("quaternion")
    step = max(float(np.median(np.diff(time))), 1e-4)
    half = max(2, round(0.025 / step))
    if len(time) < 2 * half + 1:
        return flight
    half = min(half, _enough(attitude, step))
    slope, reach = _slopes(time, attitude, half)
    (w, vector), (dw, vector_slope) = ((q[:, :1], q[:, 1:]) for q in (attitude, slope))
    rates = 2.0 * (w * vector_slope - dw * vector - np.cross(vector, vector_slope))
    rates[reach > 0.25] = np.nan
    body_rates = np.full((len(flight), 3), np.nan)
    body_rates[np.isfinite(flight.quaternion).all(1)] = rates
    note("columns", "no gyroscope was logged: body rates are derived from the attitude")
    return dataclasses.replace(flight, body_rates=body_rates, body_rates_derived=True)


def _enough(attitude: np.ndarray, step: float) -> int:
    """Rows to either side over which the slope of attitudes (R, 4) is no noisier than
    RATE_NOISE: a wide fit takes the edge off every turn, and an estimator's attitude,
    which is smooth, doesn't need it.
    """
    # Third differences hold little motion; of white noise s they are sqrt(20) s, and
    # their median size .6745 of that.
    noise = float(np.median(np.abs(np.diff(attitude, 3, axis=0)))) / (0.6745 * np.sqrt(20.0))
    half = 1
    while half < len(attitude) // 2 and 2.0 * noise / step > RATE_NOISE * np.sqrt(
        half * (half + 1) * (2 * half + 1) / 3.0
    ):
        half += 1
    return half
