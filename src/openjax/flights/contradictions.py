"""Do a flight's channels contradict each other by more than sensors can? Such a log is garbage, whatever made it
(rows out of order, columns of another flight, noise in place of data), and isn't diagnosed.

Two kinds of test. A rigid body's position, attitude and velocity are continuous: rows that follow each other at
random are no such thing (motor commands may: feedback of a noisy gyroscope does it on real vehicles). And what
one channel says, another must show: attitude and gyroscope, position and velocity, the path's acceleration and
the attitude's thrust, the accelerometer and the path, motors and force, motors and angular acceleration,
commands and what follows them. Each pair is compared where the first moves well above any sensor's noise, in a
band below that noise, with a clock offset free for every few seconds; a correlation that sensors, latencies and
air don't explain is named.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from openjax.flights.flight import Flight, Issue
from openjax.flights.reading import CHANNEL_COLUMNS
from openjax.flights.signals import (
    GRAVITY,
    RATE,
    clock_of,
    first_order,
    in_band,
    on_clock,
    rates_of,
    to_body,
    up_of,
)

WINDOW = 8.0  # s in which a clock offset is constant
LAG = 0.2  # s, largest clock offset and latency between honest streams
AGREE = 0.5  # share of the correlation to be expected below which two channels contradict each other
TELLS = 0.5  # correlation that the sensors' noise must leave for a comparison to tell anything
RANDOM = 0.5  # share of the variance from row to row at which a continuous signal has no order
LEAST_ROWS = 100
# Motion (rms in the band) that no estimate's own error looks like: a pose that a filter makes is off by a few cm/s and some
# hundredths of a radian in the same band as the motion.
MOVED = {"rate": 0.15, "velocity": 0.1, "tilt": 0.4, "acceleration": 0.1}
CLEARLY = 2.0  # times the error of the path's acceleration, by which it must exceed it
FULL = 0.98  # motor command that counts as the largest


@dataclass(frozen=True)
class Agreement:
    """How well `measured` follows `reference`, axis by axis, in the band of the comparison."""

    correlation: np.ndarray  # (C,) at the best clock offset of each window, pooled
    expected: np.ndarray  # (C,) what the white part of the measured signal leaves of a perfect one
    reference: np.ndarray  # (C,) rms of the reference in the band
    measured: np.ndarray  # (C,) rms of the measured signal in the band


def agreement(
    measured: np.ndarray,
    reference: np.ndarray,
    band: tuple[float, float],
    derivatives: tuple[int, int] = (0, 0),
) -> Agreement:
    """Compare (T, C) with (T, C) on the common clock in `band` Hz. `derivatives` says how many times each was
    differentiated from what its sensor gives."""
    y, x = in_band(measured, band), in_band(reference, band)
    width, shift = int(WINDOW * RATE), int(LAG * RATE)
    products, powers = np.zeros(y.shape[1]), np.zeros((2, y.shape[1]))
    count = max(len(y) // width, 1)
    for part in np.array_split(np.arange(len(y)), count):
        own, other = y[part], x[part]
        scale = np.sqrt((own**2).sum(0) * (other**2).sum(0)) + 1e-12
        inner = slice(shift, len(part) - shift)
        each = [(own[inner] * np.roll(other, lag, 0)[inner]).sum(0) for lag in range(-shift, shift + 1)]
        best = int(np.argmax((np.array(each) / scale).sum(1)))
        moved = np.roll(other, best - shift, 0)[inner]
        products += each[best]
        powers += [(own[inner] ** 2).sum(0), (moved**2).sum(0)]
    rms_y, rms_x = y.std(0), x.std(0)
    noise_y = _noise(measured, band, derivatives[0])
    noise_x = np.minimum(_noise(reference, band, derivatives[1]), rms_x)
    moved = np.sqrt(rms_x**2 - noise_x**2)
    expected = moved**2 / (np.maximum(rms_x, 1e-12) * np.sqrt(moved**2 + noise_y**2 + 1e-24))
    correlation = products / np.sqrt(np.maximum(powers.prod(0), 1e-24))
    return Agreement(correlation, expected, moved, rms_y)


def _noise(values: np.ndarray, band: tuple[float, float], derivatives: int) -> np.ndarray:
    """Noise (C,) in the band, if all above 20 Hz is the white noise of what was differentiated."""
    high = (20.0, 45.0)
    power = [
        np.mean(np.sin(2 * np.pi * np.linspace(*b, 50) / RATE) ** (2 * derivatives)) * (b[1] - b[0])
        for b in (band, high)
    ]
    return in_band(values, high).std(0) * np.sqrt(power[0] / power[1])


def check_contradictions(flight: Flight, vehicle) -> list[Issue]:
    """Findings on a flight that has passed all other checks; every one refuses it. `vehicle` gives the rotors'
    places."""
    found = _copied_columns(flight) + _rows_at_random(flight)
    if not found:
        grid = clock_of(flight)
        found = [] if grid is None else _pairs(flight, vehicle, grid)
    return [Issue(flight.name, f"contradictory: {text}", refused=True, kind="garbage") for text in found]


# What a finding accuses, by the columns that it names.
SUBJECTS = {
    "gyroscope": ("wx", "wy", "wz", "gyroscope"),
    "pose": ("x, y", "qw", "position axes", "quaternion", "quaternions", "the path's acceleration in"),
    "velocity": ("vx", "vy", "vz"),
    "accelerometer": ("ax", "ay", "az", "accelerometer"),
    "motors": ("m1", "motor", "motors"),
    "commands": ("cmd_",),
}


def accused_by(issue: Issue) -> set[str]:
    """The channels that a finding accuses in other flights, too."""
    if issue.kind == "units" and re.match("a[xyz]", issue.issue):
        return set()  # gravity shows in every flight
    head = issue.issue.partition(" against ")[0]
    words = set(re.findall(r"[\w_]+", head))
    return {
        subject
        for subject, marks in SUBJECTS.items()
        if any(m in words if m.isidentifier() and not m.endswith("_") else m in head for m in marks)
    }


def shown_right(flight: Flight, vehicle) -> set[str]:
    """The channels of a flight that were moved enough to be judged, and agree with the others."""
    grid, shown = clock_of(flight), set()
    if grid is not None:
        _pairs(flight, vehicle, grid, shown)
    return shown


def _copied_columns(flight: Flight) -> list[str]:
    found = []
    for channel in ("position", "velocity", "body_rates", "specific_force"):
        if getattr(flight, channel) is None:
            continue
        _, values = flight.sampled(channel)
        names = CHANNEL_COLUMNS[channel]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            if np.ptp(values[:, i]) > 0 and np.array_equal(values[:, i], values[:, j]):
                found.append(f"{names[i]} and {names[j]} hold the same values in every row")
    return found


# Standard deviation above which a channel can't be its sensor's noise.
_CONTINUOUS = {
    "position": 0.05,  # m
    "quaternion": 0.03,
    "velocity": 0.25,  # m/s
}


def _rows_at_random(flight: Flight) -> list[str]:
    """Channels without order in time: half the mean square step from row to row is the variance itself."""
    found = []
    for channel, least in _CONTINUOUS.items():
        values = getattr(flight, channel)
        if values is None or (channel == "velocity" and flight.velocity_derived):
            continue
        time, sampled = flight.sampled(channel)
        sampled = sampled.reshape(len(sampled), -1)
        near = np.diff(time) < 0.03  # s: longer steps say nothing about continuity
        if near.sum() < LEAST_ROWS:
            continue
        spread = sampled.std(0)
        ratio = 0.5 * (np.diff(sampled, axis=0)[near] ** 2).mean(0) / np.maximum(spread**2, 1e-18)
        bad = (ratio > RANDOM) & (spread > least)
        if bad.any():
            names = [n for n, b in zip(CHANNEL_COLUMNS[channel], bad, strict=True) if b]
            worst = int(np.argmax(np.where(bad, ratio, 0.0)))
            step = float(np.median(np.abs(np.diff(sampled[:, worst]))))
            found.append(
                f"the rows of {', '.join(names)} follow each other at random ({100 * ratio[worst]:.0f} % of the "
                f"variance from one row to the next, typical step {step:.2g})"
            )
    return found


def _pairs(flight: Flight, vehicle, grid: np.ndarray, shown: set[str] | None = None) -> list[str]:
    shown = set() if shown is None else shown
    position, quaternion = on_clock(flight, "position", grid), on_clock(flight, "quaternion", grid)
    velocity = None if flight.velocity_derived else on_clock(flight, "velocity", grid)
    gyro = None if flight.body_rates_derived else on_clock(flight, "body_rates", grid)
    force = on_clock(flight, "specific_force", grid)
    up = None if quaternion is None else up_of(quaternion)
    found = []

    def compare(
        names, measured, reference, band, least, what, unit, derivatives=(0, 0), either_sign=False, shows=()
    ):
        if measured is None or reference is None:
            return
        result = agreement(_columns(measured), _columns(reference), band, derivatives)
        tells = (result.reference > least) & (result.expected > TELLS)
        followed = np.abs(result.correlation) if either_sign else result.correlation
        bad = tells & (followed < AGREE * result.expected)
        if tells.sum() >= min(2, len(tells)) and not bad.any():
            shown.update(shows)
        if bad.any():
            worst = int(np.argmin(np.where(bad, followed, np.inf)))
            columns = ", ".join(n for n, b in zip(names, bad, strict=True) if b)
            found.append(
                f"{columns} against {what}: correlation {result.correlation[worst]:.2f} where sensors allow "
                f"{result.expected[worst]:.2f} ({result.measured[worst]:.2g} against {result.reference[worst]:.2g} "
                f"{unit} from {band[0]:g} to {band[1]:g} Hz)"
            )

    low, wide = (0.3, 2.5), (0.3, 4.0)
    names = CHANNEL_COLUMNS["body_rates"]
    rates = gyro
    if quaternion is not None:
        rates = rates_of(quaternion)
        compare(
            names,
            gyro,
            rates,
            wide,
            MOVED["rate"],
            "the attitude's rate",
            "rad/s",
            (0, 1),
            shows=("gyroscope", "pose"),
        )
    path = velocity
    if position is not None:
        path = np.gradient(position, 1 / RATE, axis=0)
        compare(
            CHANNEL_COLUMNS["velocity"],
            velocity,
            path,
            low,
            MOVED["velocity"],
            "the position's rate",
            "m/s",
            (0, 1),
            shows=("velocity",),
        )
        path = path if velocity is None else velocity
    along, order = None, 0
    if path is not None and up is not None:
        order = 1 if path is velocity else 2
        acceleration = np.gradient(path, 1 / RATE, axis=0)
        lift = GRAVITY if force is None else np.median(force[:, 2])
        compare(
            ("the path's acceleration in x", "in y"), acceleration[:, :2], lift * up[:, :2], low, MOVED["tilt"],
            "the attitude's thrust", "m/s^2", (order, 0), shows=("pose",),
        )  # fmt: skip
        felt = to_body(quaternion, acceleration + np.array([0.0, 0.0, GRAVITY]))
        along = felt[:, 2]
        if force is not None:
            # Sideways a late or tilted attitude feels accelerations that aren't there: the vertical alone tells.
            about, shows = "the path's acceleration", ("accelerometer",)
            # Sideways the attitude tells how wrong the path's acceleration is.
            off = in_band(acceleration[:, :2] - lift * up[:, :2], low).std(0).mean()
            least = max(MOVED["acceleration"], CLEARLY * float(off))
            compare(("az",), force[:, 2], along, low, least, about, "m/s^2", (0, order), shows=shows)
    motor, thrust = on_clock(flight, "motor_command", grid), on_clock(flight, "command_thrust", grid)
    felt = along if force is None or _feels_itself(force, along, low, order) else force[:, 2]
    collective = None if motor is None else motor.mean(1)
    together = ("m1 + m2 + m3 + m4",)
    if motor is not None and felt is not None:
        scaled = collective * np.median(felt) / max(float(np.median(collective)), 1e-3)
        order = order if felt is along else 0
        compare(together, scaled, felt, low, 0.12, "the force felt", "m/s^2", (0, order))
    if motor is not None and thrust is not None:
        compare(("cmd_thrust",), 100 * thrust, 100 * collective, wide, 1.0, "m1 + m2 + m3 + m4", "%")
    rates = gyro if gyro is not None else rates
    # A saturated vehicle has nothing left to follow commands with.
    helpless = motor is not None and float((motor > FULL).any(1).mean()) > 0.2
    if rates is not None and not helpless:
        commands = on_clock(flight, "command_body_rates", grid)
        # A loop at rest opposes what the air does: either sign is a loop.
        compare(
            CHANNEL_COLUMNS["command_body_rates"], commands, rates, low, 0.4, "the body rates", "rad/s",
            either_sign=True, shows=("commands",),
        )  # fmt: skip
        if motor is not None:
            found += _torques(motor, rates, vehicle, shown)
    return found


def _feels_itself(force: np.ndarray, along: np.ndarray | None, band, order: int) -> bool:
    """Whether what the accelerometer feels along the vertical isn't there in a path that would show it: its own vibration, which
    slow rows fold down into the band."""
    if along is None:
        return False
    seen = agreement(_columns(along), _columns(force[:, 2]), band, (order, 0))
    return bool(seen.expected[0] > TELLS and seen.correlation[0] < AGREE * seen.expected[0])


def _columns(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _torques(motor: np.ndarray, rates: np.ndarray, vehicle, shown: set[str]) -> list[str]:
    """Roll and pitch acceleration against the motors' torques, together."""
    place = np.asarray(vehicle.rotor_position, float)
    lagged = first_order(motor, float(vehicle.motor_time_constant))
    torque = lagged @ np.stack([place[:, 1], -place[:, 0]]).T
    measured = np.gradient(rates[:, :2], 1 / RATE, axis=0)
    result = agreement(measured, torque, (0.7, 8.0))
    excited = in_band(rates[:, :2], (0.7, 8.0)).std(0) > 0.3
    if excited.all() and result.correlation.min() > 0.4:
        shown.add("motors")
    if excited.all() and result.correlation.max() < 0.15:
        return [
            "the motors' torques against the angular acceleration: correlation "
            f"{result.correlation[0]:.2f} in roll and {result.correlation[1]:.2f} in pitch "
            f"while the body turns at {rates[:, :2].std():.1f} rad/s"
        ]
    return []
