"""Conditions on each channel of a flying quadrotor by itself, or beside its own sum: gravity, a
path, an order in time.
"""

import itertools
from collections.abc import Iterator

import numpy as np

from openjax.flights.flight import CHANNEL_COLUMNS, Finding, Flight
from openjax.flights.pairs import Signals
from openjax.flights.signals import RATE
from openjax.vehicle.parameters import hover_share

# share of the variance from row to row at which a continuous signal has no order
RANDOM = 0.5
LEAST_ROWS = 100  # of which a share tells order from disorder
# Standard deviation above which the rows of a continuous channel can't be its sensor's
# noise, in its unit.
CONTINUOUS = {"position": 0.05, "quaternion": 0.03, "velocity": 0.25}
LIFT = 3.0  # times its weight, which no flight's mean thrust is
MOVES = 0.05  # m, which a path must do for a velocity to contradict it
DRIFT = 0.03  # m/s by which an estimated velocity may be off on the mean
PATH_ERROR = 0.03  # m by which an estimated path may be off
# of a path over what its velocity adds up to: beyond, one isn't the other
GAINS = (0.7, 1.4)
CLEARLY = 2.0  # standard errors by which it must be: estimators of small moves drift


def gravity_findings(force: np.ndarray | None) -> list[Finding]:
    """A flying quadrotor's specific force points along body z, about 9.81 m/s^2 up,
    whatever its attitude.
    """
    if force is None:
        return []
    mean = np.median(force, 0)
    size = float(np.linalg.norm(mean))
    axis = int(np.argmax(np.abs(mean)))
    unit = (
        "in g"
        # of a flight the median lies near one in g, near a thousand in thousandths
        if 0.6 < size < 2.0
        else "in thousandths of g"
        if 600 < size < 2000
        else ""
    )
    if unit:
        return [
            ("units", f"ax, ay, az are {unit} (mean {size:.2f}); the log format wants m/s^2", ())
        ]
    if not 4.0 < size < 30.0:
        reason = "gravity was taken out" if size < 0.6 else "wrong unit or corrupt"
        text = f"the mean specific force is {size:.3g} m/s^2 and not near 9.81: {reason}"
        return [("units", f"{text}; the log format wants +9.81 m/s^2 on z at hover", ())]
    if axis != 2 or mean[2] < 0:
        sign = "minus " if mean[axis] < 0 else ""
        text = f"accelerometer axes: a{'xyz'[axis]} holds {sign}z (median {mean[axis]:.1f} m/s^2)"
        return [("axes", f"{text}; az must read +9.81 at hover", ())]
    return []


def wrong_mass(flight: Flight, vehicle) -> str:
    """In words that a vehicle can't weigh what it is told to, where its motors lift
    many times that or a fraction: a slip in the decimals, or other rotors.
    """
    if flight.motor_command is None:
        return ""
    share = float(np.nanmean(flight.motor_command)) / float(hover_share(vehicle))
    if 1.0 / LIFT < share < LIFT:
        return ""
    mass = float(vehicle.mass)
    return (
        f"the motors lift {share * mass:.2g} kg on the mean, and vehicle.mass is "
        f"{mass:.2g} kg: weigh it, or give an MJCF of its rotors as the airframe"
    )


def path_findings(signals: Signals) -> Iterator[Finding]:
    """Axes on which the position doesn't move as the velocity says, however slowly."""
    if signals.position is None or signals.velocity is None:
        return
    along = np.cumsum(signals.velocity, 0) / RATE
    for k, axis in enumerate("xyz"):
        gain, error = _gain(along[:, k], signals.position[:, k])
        back, back_error = _gain(signals.position[:, k], along[:, k])
        if _outside(gain, error, GAINS):
            text = f"{axis} moves by {gain:.2f} times what v{axis} adds up to"
        elif _outside(back, back_error, (1.0 / GAINS[1], 1.0 / GAINS[0])):
            text = f"v{axis} adds up to {back:.2f} times what {axis} moves by"
        else:
            continue
        yield "garbage", f"contradictory: {text}", ["the position's rate"]


def _gain(path: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """The distance that another path (T,) m moves per metre of this one, a steady drift aside, and
    its standard error, which is infinite if this one hardly moves.
    """
    time = np.arange(len(path)) / RATE
    columns = np.stack([path - path.mean(), time - time.mean()], 1)
    # Errors of a path last: each second says one thing.
    weight = 1.0 / (PATH_ERROR**2 * RATE)
    normal = weight * columns.T @ columns + np.diag([0.0, 1.0 / DRIFT**2])
    information = float(normal[0, 0] - normal[0, 1] ** 2 / normal[1, 1])
    if information * PATH_ERROR**2 < MOVES**2 * len(path) / RATE:
        return 1.0, np.inf
    gain = np.linalg.solve(normal, weight * columns.T @ (other - other.mean()))[0]
    return float(gain), information**-0.5


def _outside(gain: float, error: float, gains: tuple[float, float]) -> bool:
    """True if a gain is beyond these, whatever its error may be."""
    return gain + CLEARLY * error < gains[0] or gain - CLEARLY * error > gains[1]


def copied_columns(flight: Flight) -> Iterator[str]:
    """Columns of one channel that hold the same values."""
    for channel in ("position", "velocity", "body_rates", "specific_force"):
        if getattr(flight, channel) is not None:
            columns = zip(CHANNEL_COLUMNS[channel], flight.sampled(channel)[1].T, strict=True)
            for (a, one), (b, other) in itertools.combinations(columns, 2):
                if np.ptp(one) > 0 and np.array_equal(one, other):
                    yield f"contradictory: {a} and {b} hold the same values in every row"


def rows_at_random(flight: Flight) -> Iterator[str]:
    """Channels without order in time: half the mean square step from row to row is the
    variance itself.
    """
    for channel, least in CONTINUOUS.items():
        if getattr(flight, channel) is None or (channel == "velocity" and flight.velocity_derived):
            continue
        time, values = flight.sampled(channel)
        is_near = np.diff(time) < 0.03  # s: longer steps say nothing about continuity
        if is_near.sum() < LEAST_ROWS:
            continue
        spread = values.std(0)
        steps = np.diff(values, axis=0)[is_near]
        ratio = 0.5 * (steps**2).mean(0) / np.maximum(spread**2, 1e-18)
        bad = (ratio > RANDOM) & (spread > least)
        if bad.any():
            names = ", ".join(n for n, b in zip(CHANNEL_COLUMNS[channel], bad, strict=True) if b)
            yield (
                f"contradictory: the rows of {names} follow each other at random "
                f"({100 * ratio[bad].max():.0f} % of the variance from one row to the next)"
            )
