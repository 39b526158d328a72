"""What one flight says about its vehicle without a model of it: how hard each rotor works, how strongly the air
brakes, how late torques follow the motors, how noisy the sensors are. Poor in absolute terms (scales, biases
and the simulator's misfit are in them), good for comparing flights with flights, where what is shared cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.flight import Case, Flight
from openjax.flights.signals import GRAVITY, RATE, clock_of, in_band, on_clock, to_body
from openjax.flights.track import pwm_thrust

TRIMS = ("hover", "roll", "pitch", "yaw")
CLEAR_OF_FLOOR = 0.25  # m, where the ground's cushion is gone
SETTLED = 0.5  # s after take-off and before landing that are left out
BLOCK = 2.0  # s, over which rows of a flight count as one
FULL = 0.98  # motor command from which on a rotor has nothing left to trim with
LOW = 2.5  # Hz, below which drag isn't covered by vibration


@dataclass(frozen=True)
class FlightFigures:
    """One flight's figures: {name: (value, standard error)}.

    hover: mean thrust command per specific thrust, as a fraction of a rotor's maximum at 1 g; roll, pitch, yaw: the
    mixer's share of it that keeps the vehicle level (left, rear and clockwise rotors harder: positive), also
    fractions of hover; drag_x, drag_y: 1/s; lag: s; torque_gain; noise of gyroscope, accelerometer and
    motors: logarithms of the rms above 20 Hz. What the log can't give is missing.
    """

    name: str
    day: str
    values: dict[str, tuple[float, float]]
    voltage: float | None  # V, mean

    def trims(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and standard errors (4,) in the order of TRIMS."""
        return tuple(np.array([self.values[n][i] for n in TRIMS]) for i in (0, 1))


def mixer_of(vehicle) -> np.ndarray:
    """(4, 4) rows hover, roll, pitch, yaw: signs of each rotor's torque about x, y and z, and a quarter each."""
    place = np.asarray(vehicle.rotor_position, float)
    spin = np.asarray(vehicle.rotor_spin, float)
    return np.stack([np.ones(4), np.sign(place[:, 1]), -np.sign(place[:, 0]), np.sign(spin)]) / 4.0


def figures_of(flight: Flight, case: Case, day: str) -> FlightFigures | str:
    """The figures of a flight checked for a comparison, or why it has none."""
    vehicle = case.vehicle_of(flight)
    motor = flight.interpolated("motor_command")
    voltage = None if flight.battery_voltage is None else flight.interpolated("battery_voltage")
    rows = _in_the_air(flight, case)
    if rows.sum() < 100 or flight.row_period * rows.sum() < 2.0:
        return "less than 2 s clear of the floor"
    full = float((motor[rows] > FULL).any(1).mean())
    if full > 0.3:
        return f"a motor is at its limit in {full:.0%} of the rows: no trim can be told"
    if case.vehicle_file.motor_command == "pwm":
        motor = pwm_thrust(motor, voltage, vehicle)
    values = _trims(flight, motor, rows, mixer_of(vehicle)) | _dynamics(flight, case, vehicle)
    mean = None if voltage is None else float(voltage[rows].mean())
    return FlightFigures(flight.name, day, values, mean)


def _in_the_air(flight: Flight, case: Case) -> np.ndarray:
    rows = np.zeros(len(flight), bool)
    for stretch in flight.stretches(max(0.2, 5 * flight.row_period)):
        time = flight.time[stretch]
        rows[stretch] = (time > time[0] + SETTLED) & (time < time[-1] - SETTLED)
    if flight.position is not None:
        height = flight.interpolated("position")[:, 2] - float(case.vehicle_file.log.get("floor_z", 0.0))
        clear = height > CLEAR_OF_FLOOR
        # Who flies low all the time is compared as he flies.
        rows &= clear if clear[rows].mean() > 0.5 else True
    return rows


def _trims(flight: Flight, motor: np.ndarray, rows: np.ndarray, mixer: np.ndarray) -> dict:
    mixed = motor @ mixer.T
    felt = _specific_thrust(flight)
    block = (flight.time // BLOCK).astype(int)[rows]
    _, block = np.unique(block, return_inverse=True)
    count = np.bincount(block)
    means = np.stack([np.bincount(block, c[rows]) / count for c in (*mixed.T, felt)], 1)
    means = means[count > 0.5 * np.median(count)]
    weight = means.sum(0)
    out = {}
    for k, name in enumerate(TRIMS):
        below = weight[4] / GRAVITY if k == 0 else weight[0]
        value = weight[k] / below
        rest = means[:, k] - value * (means[:, 4] / GRAVITY if k == 0 else means[:, 0])
        error = np.sqrt((rest**2).sum()) / below
        out[name] = (float(value), float(error))
    return out


def _specific_thrust(flight: Flight) -> np.ndarray:
    """m/s^2 (T,), by the path and the attitude where they are known: an accelerometer's bias would be taken for
    a change of thrust. Without a path g: over a flight that starts and ends at rest it is the mean."""
    if flight.velocity is None:
        return np.full(len(flight), GRAVITY)
    velocity = flight.interpolated("velocity")
    acceleration = np.gradient(velocity, flight.time, axis=0)
    acceleration[np.abs(acceleration) > 30.0] = 0.0  # a jump of the estimate, no motion
    total = acceleration + np.array([0.0, 0.0, GRAVITY])
    if flight.quaternion is None:
        return total[:, 2]
    return to_body(flight.interpolated("quaternion"), total)[:, 2]


def _dynamics(flight: Flight, case: Case, vehicle) -> dict:
    grid = clock_of(flight)
    if grid is None or len(grid) < 4 * RATE:
        return {}
    out = {}
    gyro = None if flight.body_rates_derived else on_clock(flight, "body_rates", grid)
    force, motor = on_clock(flight, "specific_force", grid), on_clock(flight, "motor_command", grid)
    quaternion, velocity = on_clock(flight, "quaternion", grid), on_clock(flight, "velocity", grid)
    if quaternion is not None and velocity is not None:
        out |= _drag(quaternion, velocity, force)
    if gyro is not None:
        out |= _torque(motor @ mixer_of(vehicle)[1:3].T, gyro[:, :2])
    if flight.row_period < 0.015:
        for name, values in (("gyroscope", gyro), ("accelerometer", force), ("motor", motor)):
            if values is not None:
                parts = np.array_split(in_band(values, (20.0, 45.0)), 6)
                levels = np.array([0.5 * np.log((p**2).sum(1).mean() + 1e-12) for p in parts])
                out[f"{name}_noise"] = (
                    float(levels.mean()),
                    float(levels.std(ddof=1) / np.sqrt(len(levels))),
                )
    return out


def _drag(quaternion, velocity, force) -> dict:
    """Lateral specific force against velocity, both in the body frame and below LOW: -d/m, 1/s."""
    airspeed = to_body(quaternion, velocity)
    if force is None:
        force = to_body(quaternion, np.gradient(velocity, 1 / RATE, axis=0) + np.array([0.0, 0.0, GRAVITY]))
    out = {}
    for axis, name in enumerate(("drag_x", "drag_y")):
        v, f = (in_band(a[:, axis : axis + 1], (0.15, LOW))[:, 0] for a in (airspeed, force))
        if v.std() > 0.15:
            out[name] = _slope(v, -f)
    return out


def _torque(torque, rates) -> dict:
    """How late roll and pitch acceleration follow the motors' torques, and how strongly."""
    band = (1.0, 10.0)
    if in_band(rates, band).std(0).min() < 0.15:
        return {}
    y, x = in_band(np.gradient(rates, 1 / RATE, axis=0), band), in_band(torque, band)
    lags = np.arange(-5, 16)
    inner = slice(20, -20)
    estimates = []
    for part in np.array_split(np.arange(len(y)), 4):
        own, other = y[part], x[part]
        scores = np.array([(own[inner] * np.roll(other, lag, 0)[inner]).sum() for lag in lags])
        best = int(np.argmax(scores))
        if not 0 < best < len(lags) - 1:
            return {}
        a, b, c = scores[best - 1 : best + 2]
        peak = 0.5 * (a - c) / (a - 2 * b + c)
        moved = np.roll(other, lags[best], 0)[inner]
        estimates.append(
            ((lags[best] + peak) / RATE, np.log(max((own[inner] * moved).sum() / (moved**2).sum(), 1e-6)))
        )
    mean, error = np.mean(estimates, 0), np.std(estimates, 0, ddof=1) / 2.0
    return {"lag": (float(mean[0]), float(error[0])), "torque_gain": (float(mean[1]), float(error[1]))}


def _slope(x, y) -> tuple[float, float]:
    """Least-squares slope through the origin and its error, blocks as units."""
    parts = np.array_split(np.arange(len(x)), max(int(len(x) / (BLOCK * RATE)), 3))
    xy, xx = (np.array([(a[p] * b[p]).sum() for p in parts]) for a, b in ((x, y), (x, x)))
    slope = xy.sum() / xx.sum()
    error = np.sqrt(((xy - slope * xx) ** 2).sum()) / xx.sum()
    return float(slope), float(error)
