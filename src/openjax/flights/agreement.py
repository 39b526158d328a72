"""Do a flight's channels agree with each other? What one says, another must show: attitude and gyroscope, position and
velocity, the path's acceleration and the attitude's thrust, the accelerometer and the path, motors, commands and what follows
them. A log whose channels contradict each other isn't diagnosed, whatever made it: swapped axes, a wrong convention, unit or
motor order, rows out of order, columns of another flight, noise in place of data.

Each pair is compared in a low band, with a clock offset free for every few seconds, and speaks only where the one that leads
moves by more than sensors, latencies and the air explain. Where another labelling or convention mends the pair, that is
what is said."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.flights.flight import Flight, Issue
from openjax.flights.reading import CHANNEL_COLUMNS
from openjax.flights.signals import (
    RATE,
    clock_of,
    first_order,
    in_band,
    on_clock,
    rates_of,
    up_of,
)
from openjax.flights.track import GRAVITY, to_body

# Hz: above drift, below the noise of what is compared
LOW, WIDE, TURNING = (0.3, 2.5), (0.3, 4.0), (0.7, 8.0)
WINDOW = 8.0  # s in which a clock offset is constant
LAG = 0.2  # s, largest clock offset and latency between honest streams
AGREE = 0.5  # share of the correlation to be expected below which two channels contradict each other
FITS = 0.75  # share above which another labelling is what was meant
TELLS = 0.5  # correlation that the sensors' noise must leave for a comparison to tell anything
UNIT = 2.5  # factor about a unit's, within which a gain is that unit
RANDOM = 0.5  # share of the variance from row to row at which a continuous signal has no order
LEAST_ROWS = 100
FULL = 0.98  # motor command that counts as the largest
# Motion (rms in the band) that is more than what else moves the channel that must follow: a pose that a filter makes is off by a
# few cm/s and some hundredths of a radian; floor, wakes and a battery change the thrust by some per cent of hover; a loop at
# rest opposes the air. Commanded thrust and motors (per cent) are exact.
MOVED = {
    "rate": 0.15,
    "velocity": 0.1,
    "tilt": 0.4,
    "force": 0.1,
    "thrust": 0.5,
    "command": 0.4,
    "share": 0.3,
}
# Standard deviation above which the rows of a continuous channel can't be its sensor's noise, in its unit.
CONTINUOUS = {"position": 0.05, "quaternion": 0.03, "velocity": 0.25}
UNITS = {"rad/s": (("deg/s", 180 / np.pi),), "m/s": (("mm/s", 1e3),), "m/s^2": (("mm", 1e3), ("cm", 1e2))}

MOTORS = "the motors' torques"
IDENTITY = ((0, 1, 2, 3), 1.0)  # order and spin as logged
OFFSETS = range(-20, 21, 2)  # rows by which the motors' clock may be off

RELABELLINGS = [
    (list(order), np.array(signs))
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]
QUATERNIONS = {
    "in the order x, y, z, w": lambda q: q[:, [3, 0, 1, 2]],
    "from world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
    "in the order x, y, z, w and from world to body": lambda q: q[:, [3, 0, 1, 2]] * [1.0, -1.0, -1.0, -1.0],
}


def check_agreement(flight: Flight, vehicle) -> list[Issue]:
    """Findings on a flight that has passed the other checks (sorted, finite, airborne); every one refuses it. `vehicle` gives
    the rotors' places and spins."""
    found = [("garbage", text, ()) for text in (*_copied_columns(flight), *_rows_at_random(flight))]
    grid = clock_of(flight)
    if grid is not None and not found:
        signals = Signals.of(flight, grid)
        found = _gravity(signals.force) or _contradictions(signals) or _motors(signals, vehicle)
    return [Issue(flight.name, text, True, kind, tuple(against)) for kind, text, against in found]


def shown_right(flight: Flight, vehicle) -> set[str]:
    """The comparisons (`Issue.against`) that a flight without a finding moves enough to fail, and passes."""
    grid = clock_of(flight)
    if grid is None:
        return set()
    signals = Signals.of(flight, grid)
    shown = {pair.what for pair in pairs_of(signals) if pair.tells.sum() >= min(2, len(pair.tells))}
    torques = _torques(signals, vehicle)
    return shown | ({MOTORS} if torques and torques[IDENTITY][:2].min() > 0.4 else set())


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

    @classmethod
    def of(cls, flight: Flight, grid: np.ndarray) -> Signals:
        """The logged channels; what the reader derived says nothing of its own."""
        derived = {"velocity": flight.velocity_derived, "body_rates": flight.body_rates_derived}
        channels = ("position", "quaternion", "velocity", "body_rates", "specific_force")
        channels += ("motor_command", "command_thrust", "command_body_rates")
        return cls(*(None if derived.get(c) else on_clock(flight, c, grid) for c in channels))

    @cached_property
    def rates(self) -> np.ndarray | None:
        """The gyroscope, or else the attitude's rate."""
        return self.attitude_rates if self.body_rates is None else self.body_rates

    @cached_property
    def attitude_rates(self) -> np.ndarray | None:
        """Body rates (T, 3) rad/s by differences of the attitude."""
        return None if self.quaternion is None else rates_of(self.quaternion)

    @cached_property
    def acceleration(self) -> tuple[np.ndarray | None, int]:
        """Of the path, m/s^2 in the world, and how many times what was logged of it was differentiated."""
        if self.velocity is not None:
            return np.gradient(self.velocity, 1 / RATE, axis=0), 1
        if self.position is None:
            return None, 2
        return np.gradient(np.gradient(self.position, 1 / RATE, axis=0), 1 / RATE, axis=0), 2


@dataclass(frozen=True, eq=False)
class Pair:
    """`measured` (T, C) and what it must agree with, both in `unit`. `names` of the measured columns; `holds` the channel of
    `Signals` that they are, where another labelling of it may be right; `derivatives`: how many times each was differentiated
    from what its sensor gives, None for commands; `least`: rms of the reference in the band from which it tells."""

    names: tuple[str, ...]
    measured: np.ndarray
    what: str
    reference: np.ndarray
    band: tuple[float, float]
    least: float
    unit: str
    derivatives: tuple[int | None, int | None] = (0, 0)
    holds: str = ""

    @cached_property
    def agreement(self) -> Agreement:
        """How well the two follow each other."""
        return agreement(self.measured, self.reference, self.band, self.derivatives)

    @property
    def tells(self) -> np.ndarray:
        """(C,) whether the reference moves enough for a column to contradict it."""
        return (self.agreement.reference > self.least) & (self.agreement.expected > TELLS)

    @property
    def bad(self) -> np.ndarray:
        """(C,) whether a column contradicts its reference."""
        return self.tells & (self.agreement.correlation < AGREE * self.agreement.expected)

    @property
    def fits(self) -> bool:
        """Whether all columns that could contradict their reference clearly follow it."""
        followed = self.agreement.correlation[self.tells] / self.agreement.expected[self.tells]
        return bool(len(followed) and followed.min() > FITS)

    def in_words(self) -> str:
        """Which columns contradict what, with the numbers."""
        found = self.agreement
        worst = int(np.argmin(np.where(self.bad, found.correlation, np.inf)))
        columns = ", ".join(n for n, b in zip(self.names, self.bad, strict=True) if b)
        return (
            f"contradictory: {columns} against {self.what}: correlation {found.correlation[worst]:.2f} where sensors "
            f"allow {found.expected[worst]:.2f} ({found.measured[worst]:.2g} against {found.reference[worst]:.2g} "
            f"{self.unit} from {self.band[0]:g} to {self.band[1]:g} Hz)"
        )


def pairs_of(s: Signals) -> Iterator[Pair]:
    """All pairs that were logged."""
    turned, (acceleration, order) = s.attitude_rates, s.acceleration
    rates, velocity, commands = (CHANNEL_COLUMNS[c] for c in ("body_rates", "velocity", "command_body_rates"))
    if turned is not None and s.body_rates is not None:
        least, what = MOVED["rate"], "the attitude's rate"
        yield Pair(rates, s.body_rates, what, turned, WIDE, least, "rad/s", (0, 1), "body_rates")
    if s.position is not None and s.velocity is not None:
        path, what = np.gradient(s.position, 1 / RATE, axis=0), "the position's rate"
        yield Pair(velocity, s.velocity, what, path, LOW, MOVED["velocity"], "m/s", (0, 1), "velocity")
    along = None
    if acceleration is not None and s.quaternion is not None:
        size = np.full(len(acceleration), GRAVITY) if s.force is None else s.force[:, 2]
        lift = up_of(s.quaternion) * np.median(size)
        names, what = ("the path's acceleration in x", "in y"), "the attitude's thrust"
        yield Pair(
            names, acceleration[:, :2], what, lift[:, :2], LOW, MOVED["tilt"], "m/s^2", (order, 0), "position"
        )
        # Sideways a late or tilted attitude feels accelerations that aren't there: the vertical alone tells.
        along = to_body(s.quaternion, acceleration + np.array([0.0, 0.0, GRAVITY]))[:, 2:]
        if s.force is not None:
            # Sideways the attitude tells how wrong the path's acceleration is.
            off = in_band(acceleration[:, :2] - lift[:, :2], LOW).std(0).mean()
            least, what = max(MOVED["force"], 2.0 * float(off)), "the path's acceleration"
            yield Pair(("az",), s.force[:, 2:], what, along, LOW, least, "m/s^2", (0, order))
    yield from _caused(s, along, order)
    # A saturated vehicle has nothing left to follow commands with.
    helpless = s.motor is not None and float((s.motor > FULL).any(1).mean()) > 0.2
    if s.commands is not None and s.rates is not None and not helpless:
        least, what = MOVED["command"], "the body rates"
        yield Pair(commands, s.commands, what, s.rates, LOW, least, "rad/s", (None, 0), "commands")


def _caused(s: Signals, along: np.ndarray | None, order: int) -> Iterator[Pair]:
    """Motors with the force that they make and the thrust that was asked for. What the accelerometer or else the path feels
    is moved by floor, wakes and gusts, too: it must follow where the motors do much."""
    if s.motor is None:
        return
    collective = s.motor.mean(1, keepdims=True)
    felt, order = (along, order) if s.force is None else (s.force[:, 2:], 0)
    if felt is not None:
        asked = collective * np.median(felt) / max(float(np.median(collective)), 1e-3)
        what, least = "what the motors would make", MOVED["thrust"]
        yield Pair(("the force felt",), felt, what, asked, LOW, least, "m/s^2", (order, None))
    if s.thrust is not None:
        what = "m1 + m2 + m3 + m4"
        yield Pair(
            ("cmd_thrust",), 100 * s.thrust, what, 100 * collective, WIDE, MOVED["share"], "%", (None, None)
        )


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
    derivatives: tuple[int | None, int | None] = (0, 0),
) -> Agreement:
    """Compare (T, C) with (T, C) on the common clock in `band` Hz. `derivatives` says how many times each was
    differentiated from what its sensor gives; None: a command, which has no noise."""
    y, x = in_band(measured, band), in_band(reference, band)
    width, shift = int(WINDOW * RATE), int(LAG * RATE)
    products, powers = np.zeros(y.shape[1]), np.zeros((2, y.shape[1]))
    for part in np.array_split(np.arange(len(y)), max(len(y) // width, 1)):
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


def _noise(values: np.ndarray, band: tuple[float, float], derivatives: int | None) -> np.ndarray:
    """Noise (C,) in the band, if all above 20 Hz is the white noise of what was differentiated."""
    if derivatives is None:
        return np.zeros(values.shape[1])
    high = (20.0, 45.0)
    power = [
        np.mean(np.sin(2 * np.pi * np.linspace(*b, 50) / RATE) ** (2 * derivatives)) * (b[1] - b[0])
        for b in (band, high)
    ]
    return in_band(values, high).std(0) * np.sqrt(power[0] / power[1])


Finding = tuple[str, str, Sequence[str]]  # kind, words and the comparisons that fail


def _contradictions(signals: Signals) -> list[Finding]:
    """The pairs that disagree, or what mends them all; else columns in a wrong unit."""
    pairs = list(pairs_of(signals))
    bad = [pair for pair in pairs if pair.bad.any()]
    if not bad:
        return [finding for pair in pairs for finding in _unit(pair)][:1]
    mended = _mended(signals, bad)
    if mended is not None:
        return [(*mended, [pair.what for pair in bad])]
    return [("garbage", pair.in_words(), [pair.what]) for pair in bad]


def _agrees(signals: Signals, bad: list[Pair]) -> bool:
    """Whether with other `signals` no pair disagrees, and the `bad` ones clearly fit."""
    pairs = {pair.what: pair for pair in pairs_of(signals)}
    return all(pair.what in pairs and pairs[pair.what].fits for pair in bad) and not any(
        pair.bad.any() for pair in pairs.values()
    )


def _mended(signals: Signals, bad: list[Pair]) -> tuple[str, str] | None:
    """Kind and words of a convention or labelling of one channel that makes the disagreeing pairs agree."""
    if signals.quaternion is not None:
        for name, convert in QUATERNIONS.items():
            other = dataclasses.replace(signals, quaternion=convert(signals.quaternion))
            if _agrees(other, bad):
                text = f"the quaternion is {name}; the log format wants w, x, y, z from body to world"
                return "quaternion", text
    if signals.velocity is not None and signals.quaternion is not None:
        world = to_body(signals.quaternion * [1.0, -1.0, -1.0, -1.0], signals.velocity)
        if _agrees(dataclasses.replace(signals, velocity=world), bad):
            return "axes", "vx, vy, vz are in the body frame; the log format wants the world frame"
    for pair in bad:
        if pair.holds and (words := _relabelled(signals, pair, bad)):
            return "axes", words
    return None


def _relabelled(signals: Signals, pair: Pair, bad: list[Pair]) -> str:
    """Which axes of a pair's channel hold what, if the best of all 48 labellings of it makes the disagreeing pairs agree."""
    values = getattr(signals, pair.holds)
    names = CHANNEL_COLUMNS.get(pair.holds, CHANNEL_COLUMNS["command_body_rates"])
    best, most = None, -np.inf
    for order, signs in RELABELLINGS:
        changes = {pair.holds: values[:, order] * signs}
        if pair.holds == "position" and signals.velocity is not None:
            changes["velocity"] = signals.velocity[:, order] * signs
        other = next(p for p in pairs_of(dataclasses.replace(signals, **changes)) if p.what == pair.what)
        score = float(other.agreement.correlation.sum())
        if score > most + 1e-9:
            best, most = (order, signs, changes), score
    order, signs, changes = best
    if not _agrees(dataclasses.replace(signals, **changes), bad):
        return ""
    # values[:, order[i]] is what column i should hold
    held = {order[i]: f"{'minus ' if signs[i] < 0 else ''}{'xyz'[i]}" for i in range(3)}
    words = ", ".join(f"{names[k]} holds {held[k]}" for k in range(3) if held[k] != "xyz"[k])
    return f"{pair.holds.replace('_', ' ')} axes: {words}, by {pair.what}"


def _unit(pair: Pair) -> list[Finding]:
    """Columns of a pair that agrees but for its size, where a wrong unit explains that."""
    found = pair.agreement
    follows = (found.correlation > AGREE) & (found.reference > 1e-9)
    if not follows.any():
        return []
    gain = float(np.median(found.measured[follows] / found.reference[follows]))
    for unit, factor in UNITS.get(pair.unit, ()):
        for columns, times in ((", ".join(pair.names), gain), (pair.what, 1.0 / gain)):
            if factor / UNIT < times < factor * UNIT:
                wanted = "m" if pair.unit == "m/s^2" else pair.unit
                text = f"{columns}: in {unit} ({times:.0f} times too large); the log format wants {wanted}"
                return [("units", text, [pair.what])]
    return []


def _gravity(force: np.ndarray | None) -> list[Finding]:
    """A flying quadrotor's specific force points along body z, about 9.81 m/s^2 up, whatever its attitude."""
    if force is None:
        return []
    mean = np.median(force, 0)
    size, axis = float(np.linalg.norm(mean)), int(np.argmax(np.abs(mean)))
    unit = "in g" if 0.6 < size < 2.0 else "in thousandths of g" if 600 < size < 2000 else ""
    if unit:
        return [("units", f"ax, ay, az are {unit} (mean {size:.2f}); the log format wants m/s^2", ())]
    if not 4.0 < size < 30.0:
        why = "gravity was taken out" if size < 0.6 else "wrong unit or corrupt"
        text = f"the mean specific force is {size:.3g} m/s^2 and not near 9.81: {why}"
        return [("units", f"{text}; the log format wants +9.81 m/s^2 on z at hover", ())]
    if axis != 2 or mean[2] < 0:
        sign = "minus " if mean[axis] < 0 else ""
        text = f"accelerometer axes: a{'xyz'[axis]} holds {sign}z (median {mean[axis]:.1f} m/s^2)"
        return [("axes", f"{text}; az must read +9.81 at hover", ())]
    return []


def _motors(s: Signals, vehicle) -> list[Finding]:
    """Motors in another order or with other spins, or whose torques the body doesn't follow at all."""
    torques = _torques(s, vehicle)
    if not torques:
        return []
    logged, (rotors, best) = torques[IDENTITY], max(torques.items(), key=lambda item: item[1].sum())
    # The right order explains every axis; an offset mass or weak motor can spoil one or two, and isn't an order.
    if (
        best.min() > 0.4
        and best.mean() > 0.65
        and (logged < AGREE * best).any()
        and (best - logged).sum() > 0.6
    ):
        return [("motors", _order_in_words(*rotors), [MOTORS])]
    if (in_band(s.rates[:, :2], TURNING).std(0) > 0.3).all() and logged[:2].max() < 0.15:
        text = f"correlation {logged[0]:.2f} in roll and {logged[1]:.2f} in pitch"
        text += f" while the body turns at {s.rates[:, :2].std():.1f} rad/s"
        return [("garbage", f"contradictory: {MOTORS} against the angular acceleration: {text}", [MOTORS])]
    return []


def _torques(s: Signals, vehicle) -> dict[tuple, np.ndarray]:
    """{(order, spin's sign): correlation (3,) of the angular acceleration with the torques that motors in this order make}."""
    if s.motor is None or s.rates is None:
        return {}
    place, spin = np.asarray(vehicle.rotor_position, float), np.asarray(vehicle.rotor_spin, float)
    mixing = np.stack([place[:, 1], -place[:, 0], spin])  # roll, pitch and yaw torque per thrust
    measured = in_band(np.gradient(s.rates, 1 / RATE, axis=0), TURNING)
    lagged = in_band(first_order(s.motor, float(vehicle.motor_time_constant)), TURNING)
    if (lagged.std(0) < 1e-6).all():
        return {}
    # Motors are correlated, so whole torques are scored: by the moments of angular acceleration and motors at each offset.
    shifted = np.stack([np.roll(lagged, lag, 0) for lag in OFFSETS])
    cross = np.einsum("ti,ltj->lij", measured, shifted)
    among = np.einsum("lti,ltj->lij", shifted, shifted)
    found = {}
    for order, flip in itertools.product(itertools.permutations(range(4)), (1.0, -1.0)):
        mixed = mixing[:, order] * [[1.0], [1.0], [flip]]
        power = np.einsum("ij,ljk,ik->li", mixed, among, mixed) * (measured**2).sum(0)
        each = (mixed * cross).sum(2) / np.sqrt(np.maximum(power, 1e-24))
        found[order, flip] = each[int(np.argmax(each.sum(1)))]
    return found


def _order_in_words(order: tuple[int, ...], flip: float) -> str:
    if order == IDENTITY[0]:
        text = "the rotors' spin is opposite: yaw accelerates against the torque of m1..m4"
        return f"{text}; reverse motor.spin in vehicle.toml"
    names = ("front_right", "rear_right", "rear_left", "front_left")
    words = ", ".join(f"m{i + 1} {names[o]}" for i, o in enumerate(order))
    words += " with the spins reversed" if flip < 0 else ""
    text = f"motor order: the angular acceleration fits only if (in the nominal order) {words}"
    return f"{text}; correct motor.order in vehicle.toml"


def _copied_columns(flight: Flight) -> Iterator[str]:
    for channel in ("position", "velocity", "body_rates", "specific_force"):
        if getattr(flight, channel) is not None:
            columns = zip(CHANNEL_COLUMNS[channel], flight.sampled(channel)[1].T, strict=True)
            for (a, one), (b, other) in itertools.combinations(columns, 2):
                if np.ptp(one) > 0 and np.array_equal(one, other):
                    yield f"contradictory: {a} and {b} hold the same values in every row"


def _rows_at_random(flight: Flight) -> Iterator[str]:
    """Channels without order in time: half the mean square step from row to row is the variance itself."""
    for channel, least in CONTINUOUS.items():
        if getattr(flight, channel) is None or (channel == "velocity" and flight.velocity_derived):
            continue
        time, values = flight.sampled(channel)
        near = np.diff(time) < 0.03  # s: longer steps say nothing about continuity
        if near.sum() < LEAST_ROWS:
            continue
        spread, steps = values.std(0), np.diff(values, axis=0)[near]
        ratio = 0.5 * (steps**2).mean(0) / np.maximum(spread**2, 1e-18)
        bad = (ratio > RANDOM) & (spread > least)
        if bad.any():
            names = ", ".join(n for n, b in zip(CHANNEL_COLUMNS[channel], bad, strict=True) if b)
            yield (
                f"contradictory: the rows of {names} follow each other at random ({100 * ratio[bad].max():.0f} % of "
                "the variance from one row to the next)"
            )
