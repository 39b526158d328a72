"""Pairs of a flight's channels that must follow each other, and how well they do.

Each pair is compared in a low band, with a clock offset free for every few seconds, and speaks only
where the one that leads moves by more than sensors, latencies and the air explain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool

from openjax.flights.flight import CHANNEL_COLUMNS, Flight
from openjax.flights.shapes import Columns, Times, Vectors
from openjax.flights.signals import RATE, in_band, on_clock, rates_of
from openjax.flights.track import GRAVITY, rotation, to_body

# Hz: above drift, below the noise of what is compared
LOW = (0.3, 2.5)
WIDE = (0.3, 4.0)
TURNING = (0.7, 8.0)  # where motors turn the vehicle
WINDOW = 8.0  # s in which a clock offset is constant
LAG = 0.2  # s, largest clock offset and latency between honest streams
# share of the correlation to be expected below which two channels contradict each other
AGREE = 0.5
FITS = 0.75  # share above which another labelling is what was meant
# correlation that the sensors' noise must leave for a comparison to tell anything
TELLS = 0.5
# motor command that counts as the largest: a rotor has nothing left to trim with
FULL = 0.98
# Motion (rms in the band) that is more than what else moves the channel that must
# follow: a pose that a filter makes is off by a few cm/s and some hundredths of a
# radian; floor, wakes and a battery change the thrust by some per cent of hover; a loop
# at rest opposes the air. Commanded thrust and motors (per cent) are exact.
MOVED = {
    "rate": 0.15,
    "velocity": 0.1,
    "tilt": 0.4,
    "force": 0.1,
    "thrust": 0.5,
    "command": 0.4,
    "share": 0.3,
    "rotor": 1.0,
}


@dataclass(frozen=True, eq=False)
class Signals:
    """A flight's channels (T, C) on the common clock; None where they weren't logged."""

    position: np.ndarray | None
    quaternion: np.ndarray | None
    velocity: np.ndarray | None
    body_rates: np.ndarray | None
    force: np.ndarray | None
    motor: np.ndarray | None
    thrust: np.ndarray | None
    commands: np.ndarray | None
    rotors: np.ndarray | None = None

    @classmethod
    def of(cls, flight: Flight, grid: Times) -> Signals:
        """The logged channels; what the reader derived says nothing of its own."""
        is_derived = {
            "velocity": flight.velocity_derived,
            "body_rates": flight.body_rates_derived,
            "quaternion": flight.attitude_derived,
        }
        channels = ("position", "quaternion", "velocity", "body_rates", "specific_force")
        channels += ("motor_command", "command_thrust", "command_body_rates", "rotor_speed")
        return cls(*(None if is_derived.get(c) else on_clock(flight, c, grid) for c in channels))

    @cached_property
    def rates(self) -> Vectors | None:
        """The gyroscope, or else the attitude's rate."""
        return self.attitude_rates if self.body_rates is None else self.body_rates

    @cached_property
    def attitude_rates(self) -> Vectors | None:
        """Body rates (T, 3) rad/s by differences of the attitude."""
        return None if self.quaternion is None else rates_of(self.quaternion)

    @cached_property
    def has_saturation(self) -> bool:
        """True if motors often have nothing left to follow commands with."""
        return self.motor is not None and float((self.motor > FULL).any(1).mean()) > 0.2

    @cached_property
    def acceleration(self) -> tuple[Vectors | None, int]:
        """Of the path, m/s^2 in the world, and how many times what was logged of it was
        differentiated.
        """
        if self.velocity is not None:
            return np.gradient(self.velocity, 1 / RATE, axis=0), 1
        if self.position is None:
            return None, 2
        return np.gradient(np.gradient(self.position, 1 / RATE, axis=0), 1 / RATE, axis=0), 2


@dataclass(frozen=True, eq=False)
class SignalPair:
    """`signal` (T, C) and what it must agree with, both in `unit`. `names` of the measured columns;
    `holds` the channel of `Signals` that they are, where another labelling of it may be right;
    `derivatives`: how many times each was differentiated from what its sensor gives, None for
    commands; `least`: rms of the reference in the band from which it tells.
    """

    names: tuple[str, ...]
    signal: np.ndarray
    what: str
    reference: np.ndarray
    band: tuple[float, float]
    least: float
    unit: str
    derivatives: tuple[int | None, int | None] = (0, 0)
    holds: str = ""

    @cached_property
    def agreement(self) -> Agreement:
        """A measure of how well the two follow each other."""
        return agreement(self.signal, self.reference, self.band, self.derivatives)

    @property
    def tells(self) -> Bool[np.ndarray, " columns"]:
        """(C,) whether the reference moves enough for a column to contradict it."""
        return (self.agreement.reference > self.least) & (self.agreement.expectation > TELLS)

    @property
    def bad(self) -> Bool[np.ndarray, " columns"]:
        """(C,) whether a column contradicts its reference."""
        return self.tells & (self.agreement.correlation < AGREE * self.agreement.expectation)

    @property
    def fits(self) -> bool:
        """True if all columns that could contradict their reference clearly follow it."""
        shares = self.agreement.correlation[self.tells] / self.agreement.expectation[self.tells]
        return bool(len(shares) and shares.min() > FITS)

    def in_words(self) -> str:
        """The columns that contradict each other, with the numbers."""
        agreement = self.agreement
        worst = int(np.argmin(np.where(self.bad, agreement.correlation, np.inf)))
        columns = ", ".join(n for n, b in zip(self.names, self.bad, strict=True) if b)
        low, high = self.band
        return (
            f"contradictory: {columns} against {self.what}: correlation "
            f"{agreement.correlation[worst]:.2f} where sensors allow "
            f"{agreement.expectation[worst]:.2f} ({agreement.signal[worst]:.2g} against "
            f"{agreement.reference[worst]:.2g} {self.unit} from {low:g} to {high:g} Hz)"
        )


def pairs_of(s: Signals) -> Iterator[SignalPair]:
    """All pairs that were logged."""
    yield from _derived_pairs(s)
    acceleration, order = s.acceleration
    along = None
    if acceleration is not None and s.quaternion is not None:
        # sideways a late or tilted attitude feels accelerations that aren't there: the
        # vertical alone tells
        upright = acceleration + np.array([0.0, 0.0, GRAVITY])
        along = to_body(s.quaternion, upright)[:, 2:]
        yield from _felt(s, acceleration, along, order)
    yield from _caused_pairs(s, along, order)
    if s.commands is not None and s.rates is not None and not s.has_saturation:
        yield SignalPair(
            names=CHANNEL_COLUMNS["command_body_rates"],
            signal=s.commands,
            what="the body rates",
            reference=s.rates,
            band=LOW,
            least=MOVED["command"],
            unit="rad/s",
            derivatives=(None, 0),
            holds="commands",
        )


def _derived_pairs(s: Signals) -> Iterator[SignalPair]:
    """Body rates with the attitude, and the velocity with the position."""
    attitude_rates = s.attitude_rates
    if attitude_rates is not None and s.body_rates is not None:
        yield SignalPair(
            names=CHANNEL_COLUMNS["body_rates"],
            signal=s.body_rates,
            what="the attitude's rate",
            reference=attitude_rates,
            band=WIDE,
            least=MOVED["rate"],
            unit="rad/s",
            derivatives=(0, 1),
            holds="body_rates",
        )
    if s.position is not None and s.velocity is not None:
        yield SignalPair(
            names=CHANNEL_COLUMNS["velocity"],
            signal=s.velocity,
            what="the position's rate",
            reference=np.gradient(s.position, 1 / RATE, axis=0),
            band=LOW,
            least=MOVED["velocity"],
            unit="m/s",
            derivatives=(0, 1),
            holds="velocity",
        )


def _felt(
    s: Signals, acceleration: np.ndarray, along: np.ndarray, order: int
) -> Iterator[SignalPair]:
    """The path's acceleration with what an attitude and an accelerometer make of it;
    `along` (T, 1) is that along the body's z axis.
    """
    size = np.full(len(acceleration), GRAVITY) if s.force is None else s.force[:, 2]
    lift = rotation(s.quaternion)[:, :, 2] * np.median(size)
    yield SignalPair(
        names=("the path's acceleration in x", "in y"),
        signal=acceleration[:, :2],
        what="the attitude's thrust",
        reference=lift[:, :2],
        band=LOW,
        least=MOVED["tilt"],
        unit="m/s^2",
        derivatives=(order, 0),
        holds="position",
    )
    if s.force is not None:
        # sideways the attitude tells how wrong the path's acceleration is
        off = in_band(acceleration[:, :2] - lift[:, :2], LOW).std(0).mean()
        yield SignalPair(
            names=("az",),
            signal=s.force[:, 2:],
            what="the path's acceleration",
            reference=along,
            band=LOW,
            least=max(MOVED["force"], 2.0 * float(off)),
            unit="m/s^2",
            derivatives=(0, order),
        )


def _caused_pairs(s: Signals, along: np.ndarray | None, order: int) -> Iterator[SignalPair]:
    """Motors with the force that they make and the thrust that was asked for. What the
    accelerometer or else the path feels is moved by floor, wakes and gusts, too: it
    must follow where the motors do much.
    """
    if s.motor is None:
        return
    if s.rotors is not None:
        yield SignalPair(
            names=CHANNEL_COLUMNS["rotor_speed"],
            signal=100 * s.rotors / np.median(s.rotors),
            what="m1, m2, m3, m4",
            reference=100 * s.motor,
            band=TURNING,
            least=MOVED["rotor"],
            unit="%",
            derivatives=(0, None),
        )
    collective = s.motor.mean(1, keepdims=True)
    force, order = (along, order) if s.force is None else (s.force[:, 2:], 0)
    if force is not None:
        usual = max(float(np.median(collective)), 1e-3)
        pair = SignalPair(
            names=("the force felt",),
            signal=force,
            what="what the motors would make",
            reference=collective * np.median(force) / usual,
            band=LOW,
            least=MOVED["thrust"],
            unit="m/s^2",
            derivatives=(order, None),
        )
        yield pair if not pair.bad.any() else _without_air(s, pair)
    if s.thrust is not None and not s.has_saturation:
        yield SignalPair(
            names=("cmd_thrust",),
            signal=100 * s.thrust,
            what="m1 + m2 + m3 + m4",
            reference=100 * collective,
            band=WIDE,
            least=MOVED["share"],
            unit="%",
            derivatives=(None, None),
        )


def _without_air(s: Signals, pair: SignalPair) -> SignalPair:
    """A pair of a force along the body's z axis without what goes with the air, where
    attitude and velocity say how that goes: drag by the vehicle's own motion, and by a
    steady wind that a leaning body meets along z. Motors answer both, so both sides lose it,
    and what is left tells at half the usual size: less moves it.
    """
    if s.quaternion is None or s.velocity is None:
        return pair
    own_drag = to_body(s.quaternion, s.velocity)[:, 2:]
    air = np.concatenate([own_drag, rotation(s.quaternion)[:, :2, 2]], 1)
    sides = np.concatenate([pair.signal, pair.reference], 1)
    weights = np.linalg.lstsq(in_band(air, pair.band), in_band(sides, pair.band), rcond=None)[0]
    signal, reference = np.split(sides - air @ weights, 2, axis=1)
    return replace(pair, signal=signal, reference=reference, least=0.5 * pair.least)


@dataclass(frozen=True)
class Agreement:
    """The agreement of `signal` with `reference`, axis by axis, in the band of the comparison."""

    correlation: np.ndarray  # (C,) at the best clock offset of each window, pooled
    # (C,) what the white part of the measured signal leaves of a perfect one
    expectation: np.ndarray
    reference: np.ndarray  # (C,) rms of the reference in the band
    signal: np.ndarray  # (C,) rms of the measured signal in the band


def agreement(
    signal: Columns,
    reference: Columns,
    band: tuple[float, float],
    derivatives: tuple[int | None, int | None] = (0, 0),
) -> Agreement:
    """Compare (T, C) with (T, C) on the common clock in `band` Hz. `derivatives` says how many
    times each was differentiated from what its sensor gives; None: a command, which has no noise.
    """
    y = in_band(signal, band)
    x = in_band(reference, band)
    width = int(WINDOW * RATE)
    shift = int(LAG * RATE)
    products = np.zeros(y.shape[1])
    powers = np.zeros((2, y.shape[1]))
    for part in np.array_split(np.arange(len(y)), max(len(y) // width, 1)):
        values = y[part]
        other = x[part]
        scale = np.sqrt((values**2).sum(0) * (other**2).sum(0)) + 1e-12
        inner = slice(shift, len(part) - shift)
        each = [
            (values[inner] * np.roll(other, lag, 0)[inner]).sum(0)
            for lag in range(-shift, shift + 1)
        ]
        best = int(np.argmax((np.array(each) / scale).sum(1)))
        aligned_part = np.roll(other, best - shift, 0)[inner]
        products += each[best]
        powers += [(values[inner] ** 2).sum(0), (aligned_part**2).sum(0)]
    rms_y = y.std(0)
    rms_x = x.std(0)
    noise_y = _noise(signal, band, derivatives[0])
    noise_x = np.minimum(_noise(reference, band, derivatives[1]), rms_x)
    aligned_part = np.sqrt(rms_x**2 - noise_x**2)
    expectation = aligned_part**2 / (
        np.maximum(rms_x, 1e-12) * np.sqrt(aligned_part**2 + noise_y**2 + 1e-24)
    )
    correlation = products / np.sqrt(np.maximum(powers.prod(0), 1e-24))
    return Agreement(correlation, expectation, aligned_part, rms_y)


def _noise(values: np.ndarray, band: tuple[float, float], derivatives: int | None) -> np.ndarray:
    """Noise (C,) in the band, if all above 20 Hz is the white noise of what was differentiated."""
    if derivatives is None:
        return np.zeros(values.shape[1])
    # up to a tenth below the highest frequency of the clock
    high = (20.0, 45.0)
    power = [
        np.mean(np.sin(2 * np.pi * np.linspace(*b, 50) / RATE) ** (2 * derivatives)) * (b[1] - b[0])
        for b in (band, high)
    ]
    return in_band(values, high).std(0) * np.sqrt(power[0] / power[1])
