"""What the motor commands of one flight say about its vehicle without a model of it: how
hard each rotor works, and how much it all shakes. Poor in absolute terms (scales, biases
and the simulator's misfit are in them), good for comparing flights with flights, where
what is shared cancels.
"""

from dataclasses import dataclass

import numpy as np

from openjax.flights.flight import Case, Flight
from openjax.flights.grid import pwm_thrust
from openjax.flights.pairs import FULL
from openjax.flights.signals import RATE, clock_of, first_order, in_band, on_clock
from openjax.flights.track import GRAVITY, to_body
from openjax.gap.decision import DECISION

CLEAR_OF_FLOOR = 0.25  # m, where the ground's cushion is gone
SETTLED = 0.5  # s after a stretch's begin and before its end that are left out
BLOCK = 2.0  # s, over which rows of a flight count as one
TURNING = (1.0, 10.0)  # Hz, where motors turn the vehicle
DELAYS = (0, 2, 4, 6)  # rows, of the commands as instruments
# Hz, where the rate loop's proportional part outweighs its integral
ANSWERING = (4.0, 15.0)
LAGS = np.geomspace(0.004, 0.2, 40)  # s, time constants that are tried
SHAKING = (20.0, 45.0)  # Hz
SLOW = 0.015  # s, rows from which on these don't show


@dataclass(frozen=True)
class Figure:
    """A figure in words, its unit and the factor to it (0: a logarithm, told as
    a change in per cent), and its standard deviations over a vehicle's normal days and
    over flights within a day.
    """

    words: str
    unit: str
    factor: float
    day: float
    within: float


# Trims, as shares of hover: 1 to 2.5 % over days, measured on published flights of two
# Crazyflies; yaw more, because its torque is a hundredth of thrust times arm and a
# tilted motor shows in it. Gains are the firmware's numbers, which no day moves: theirs
# is what the estimate repeats to in flights of different kinds.
FIGURES = {
    "hover": Figure("thrust command at hover", "%", 0.0, 0.012, 0.003),
    "roll": Figure("roll trim", "% of hover", 100.0, 0.02, 0.0025),
    "pitch": Figure("pitch trim", "% of hover", 100.0, 0.02, 0.0025),
    "yaw": Figure("yaw trim", "% of hover", 100.0, 0.03, 0.005),
    "lag": Figure("time constant from motors to angular acceleration", "%", 0.0, 0.1, 0.05),
    "loop_gain": Figure("motor command per rate error", "%", 0.0, 0.02, 0.02),
    "shaking": Figure("gyroscope and motors above 20 Hz", "%", 0.0, 0.35, 0.1),
}
PLACES = {name: place for place, name in enumerate(FIGURES)}
TRIMS = ("hover", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class FlightFigures:
    """One flight's figures: {name: (value, standard error)}.

    hover: mean thrust command per specific thrust, as a fraction of a rotor's maximum
    at 1 g; roll, pitch, yaw: the mixer's share of it that keeps the vehicle level
    (left, rear and clockwise rotors harder: positive), also fractions of hover.
    Logarithms of: lag, the time constant in s from motors to angular acceleration;
    loop_gain, command per rate error; shaking, the rms of gyroscope and motors above 20
    Hz. What the log can't give is missing.
    """

    name: str
    day: str
    values: dict[str, tuple[float, float]]
    voltage: float | None  # V, mean
    duty: bool = False  # motors are duty cycles

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and standard errors (F,) in the order of FIGURES, NaN where the log
        gives none.
        """
        both = [self.values.get(n, (np.nan, np.nan)) for n in FIGURES]
        return tuple(np.array(part, float) for part in zip(*both, strict=True))


def mixer_of(vehicle) -> np.ndarray:
    """(4, 4) rows hover, roll, pitch, yaw: signs of each rotor's torque about x, y and
    z, and a quarter each.
    """
    place = np.asarray(vehicle.rotor_position, float)
    spin = np.asarray(vehicle.rotor_spin, float)
    return np.stack([np.ones(4), np.sign(place[:, 1]), -np.sign(place[:, 0]), np.sign(spin)]) / 4.0


def figures_of(flight: Flight, case: Case, day: str) -> FlightFigures | str:
    """The figures of a flight checked for a comparison, or why it has none."""
    vehicle = case.vehicle_of(flight)
    motor = flight.interpolated("motor_command")
    voltage = None if flight.battery_voltage is None else flight.interpolated("battery_voltage")
    rows = _settled_rows(flight, case)
    if rows.sum() < 100 or flight.row_period * rows.sum() < 2.0:
        return "less than 2 s clear of the floor"
    full = float((motor[rows] > FULL).any(1).mean())
    if full > 0.3:
        return f"a motor is at its limit in {full:.0%} of the rows: no trim can be told"
    if case.vehicle_file.motor.command == "pwm":
        motor = pwm_thrust(motor, voltage, vehicle)
    values = (
        _trims(flight, motor, rows, mixer_of(vehicle))
        | _rate_loop(flight, mixer_of(vehicle))
        | _shaking(flight)
    )
    mean = None if voltage is None else float(voltage[rows].mean())
    duty = case.vehicle_file.motor.command == "pwm"
    return FlightFigures(flight.name, day, values, mean, duty)


def _settled_rows(flight: Flight, case: Case) -> np.ndarray:
    """(T,) which rows, all in the air, are away from where a stretch of them begins or
    ends, and from the floor.
    """
    rows = np.zeros(len(flight), bool)
    for stretch in flight.stretches(max(0.2, 5 * flight.row_period)):
        time = flight.time[stretch]
        rows[stretch] = (time > time[0] + SETTLED) & (time < time[-1] - SETTLED)
    if flight.position is not None:
        height = flight.interpolated("position")[:, 2] - float(
            case.vehicle_file.log.get("floor_z", 0.0)
        )
        clear = height > CLEAR_OF_FLOOR
        # Who flies low all the time is compared as he flies.
        rows &= clear if clear[rows].mean() > 0.5 else True
    return rows


def _trims(flight: Flight, motor: np.ndarray, rows: np.ndarray, mixer: np.ndarray) -> dict:
    wrench = motor @ mixer.T
    specific_thrust = _specific_thrust(flight)
    block = (flight.time // BLOCK).astype(int)[rows]
    _, block = np.unique(block, return_inverse=True)
    count = np.bincount(block)
    means = np.stack([np.bincount(block, c[rows]) / count for c in (*wrench.T, specific_thrust)], 1)
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
    """m/s^2 (T,), by the path and the attitude where they are known: an accelerometer's
    bias would be taken for a change of thrust. Without a path g: over a flight that
    starts and ends at rest it is the mean.
    """
    if flight.velocity is None:
        return np.full(len(flight), GRAVITY)
    velocity = flight.interpolated("velocity")
    acceleration = np.gradient(velocity, flight.time, axis=0)
    acceleration[np.abs(acceleration) > 30.0] = 0.0  # a jump of the estimate, no motion
    total = acceleration + np.array([0.0, 0.0, GRAVITY])
    if flight.quaternion is None:
        return total[:, 2]
    return to_body(flight.interpolated("quaternion"), total)[:, 2]


def _rate_loop(flight: Flight, mixer: np.ndarray) -> dict:
    """The delay of torques after the motors, and how strongly the rate loop answers."""
    grid = clock_of(flight)
    has_rates = flight.body_rates is not None and not flight.body_rates_derived
    if grid is None or len(grid) < 4 * RATE or not has_rates:
        return {}
    torque = on_clock(flight, "motor_command", grid) @ mixer[1:3].T
    rates = on_clock(flight, "body_rates", grid)[:, :2]
    commands = on_clock(flight, "command_body_rates", grid)
    answer = {} if commands is None else _loop(torque, rates, commands[:, :2])
    return _lag(torque, rates) | answer


def _lag(torque, rates) -> dict:
    """The time constant from roll and pitch torques to angular accelerations: of all
    first-order lags the one whose output correlates best, by quarters of the flight.
    """
    if in_band(rates, TURNING).std(0).min() < 0.15:
        return {}
    y = in_band(np.gradient(rates, 1 / RATE, axis=0), TURNING)
    outputs = np.stack([in_band(first_order(torque, lag), TURNING) for lag in LAGS])
    estimates = []
    for part in np.array_split(np.arange(len(y)), 4):
        cross = (y[part] * outputs[:, part]).sum((1, 2))
        scores = cross / np.sqrt((outputs[:, part] ** 2).sum((1, 2)))
        best = int(np.argmax(scores))
        if not 0 < best < len(LAGS) - 1 or cross[best] <= 0:
            return {}
        a, b, c = scores[best - 1 : best + 2]
        peak = 0.5 * (a - c) / (a - 2 * b + c) * np.log(LAGS[1] / LAGS[0])
        estimates.append(np.log(LAGS[best]) + peak)
    return {"lag": (float(np.mean(estimates)), float(np.std(estimates, ddof=1) / 2.0))}


def _loop(torque, rates, commands) -> dict:
    """The strength of the rate loop's answer to a rate error, beside what it answers to a
    change of the rates, by quarters of the flight. In closed loop noise is in all
    three, so the commands are the instruments (two-stage least squares).
    """
    # motors hold from a row to the next: rates count in the middle
    next_rates = np.concatenate([rates[1:], rates[-1:]])
    error = commands - 0.5 * (rates + next_rates)
    change = (next_rates - rates) * RATE
    signals = (torque, error, change, *(np.roll(commands, k, 0) for k in DELAYS))
    band = np.stack([in_band(values, ANSWERING) for values in signals], -1)
    gains = []
    for part in np.array_split(band, 4):
        target, regressors, instruments = np.split(part.reshape(-1, len(signals)), (1, 3), axis=1)
        projection = instruments @ np.linalg.lstsq(instruments, regressors, rcond=None)[0]
        if min((projection**2).sum(0) / (regressors**2).sum(0)) < DECISION.least_excitation:
            return {}
        gains.append(np.linalg.lstsq(projection, target[:, 0], rcond=None)[0][0])
    if min(gains) <= 0:
        return {}
    logs = np.log(gains)
    return {"loop_gain": (float(logs.mean()), float(logs.std(ddof=1) / 2.0))}


def _shaking(flight: Flight) -> dict:
    """Mean logarithm of the rms of gyroscope and motors above 20 Hz, sixths of the
    flight as units; nothing of a log that is too short or too slow to hold it.
    """
    grid = clock_of(flight)
    has_gyroscope = flight.body_rates is not None and not flight.body_rates_derived
    if grid is None or len(grid) < 4 * RATE or not has_gyroscope:
        return {}
    if flight.row_period >= SLOW:
        return {}
    parts = [
        np.array_split(in_band(on_clock(flight, channel, grid), SHAKING), 6)
        for channel in ("body_rates", "motor_command")
    ]
    each = np.mean(
        [[0.5 * np.log((p**2).sum(1).mean() + 1e-12) for p in power] for power in parts], 0
    )
    return {"shaking": (float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))))}
