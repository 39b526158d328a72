"""Do a flight's channels agree with each other? What one says, another must show: attitude and
gyroscope, position and velocity, the path's acceleration and the attitude's thrust, the
accelerometer and the path, motors, commands and what follows them. A log whose channels contradict
each other isn't diagnosed, whatever made it: swapped axes, a wrong convention, unit or motor order,
rows out of order, columns of another flight, noise in place of data. Where another labelling or
convention mends a pair, that is what is said.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.flights.conventions import BODY, CONVENTIONS, FRAMES, upright
from openjax.flights.flight import CHANNEL_COLUMNS, Flight, Issue
from openjax.flights.pairs import AGREE, WIDE, Pair, Signals, pairs_of
from openjax.flights.signals import RATE, clock_of, first_order, in_band, rates_of
from openjax.flights.track import rotation, to_body

TURNING = (0.7, 8.0)  # Hz, where motors turn the vehicle
UNIT = 2.5  # factor about a unit's, within which a gain is that unit
CLEAR = 0.9  # correlation from which a gain is one
SAME = 1.4  # factor by which two sensors of one rate may differ
RANDOM = 0.5  # share of the variance from row to row at which a continuous signal has no order
LEAST_ROWS = 100
# Standard deviation above which the rows of a continuous channel can't be its sensor's noise, in
# its unit.
CONTINUOUS = {"position": 0.05, "quaternion": 0.03, "velocity": 0.25}
UNITS = {
    "rad/s": (("deg/s", 180 / np.pi),),
    "m/s": (("mm/s", 1e3),),
    "m/s^2": (("mm", 1e3), ("cm", 1e2)),
}

MOTORS = "the motors' torques"
IDENTITY = ((0, 1, 2, 3), 1.0)  # order and spin as logged
OFFSETS = range(-20, 21, 2)  # rows by which the motors' clock may be off

RELABELLINGS = [
    (list(order), np.array(signs))
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]

WANTED = "the log format wants w, x, y, z from body to world"
INVERSE = np.array([1.0, -1.0, -1.0, -1.0])
QUATERNIONS = {
    f"the quaternion is in the order x, y, z, w; {WANTED}": lambda q: q[:, [3, 0, 1, 2]],
    f"the quaternion is from world to body; {WANTED}": lambda q: q * INVERSE,
    f"the quaternion is in the order x, y, z, w and from world to body; {WANTED}": lambda q: (
        q[:, [3, 0, 1, 2]] * INVERSE
    ),
}
UPRIGHT = 0.5  # mean cosine of the tilt of whatever flies by thrust
FOLLOWED = 0.7  # correlation of turning and gyroscope from which an attitude is tried in full
MOVES = 0.05  # m, which a path must do for a velocity to contradict it
DRIFT = 0.03  # m/s by which an estimated velocity may be off on the mean
PATH_ERROR = 0.03  # m by which an estimated path may be off
GAINS = (0.7, 1.4)  # of a path over what its velocity adds up to: beyond, one isn't the other
Finding = tuple[str, str, Sequence[str]]  # kind, words and the comparisons that fail


def check_agreement(flight: Flight, vehicle) -> list[Issue]:
    """Findings on a flight that has passed the other checks (sorted, finite, airborne); every one
    refuses it. `vehicle` gives the rotors' places and spins.
    """
    found = [("garbage", text, ()) for text in (*_copied_columns(flight), *_rows_at_random(flight))]
    grid = clock_of(flight)
    if grid is not None and not found:
        signals = Signals.of(flight, grid)
        found = (
            _upside_down(signals)
            or _gravity(signals.force)
            or _inverted(signals)
            or _contradictions(signals)
            or list(_paths(signals))
            or _motors(signals, vehicle)
        )
    return [Issue(flight.name, text, True, kind, tuple(against)) for kind, text, against in found]


def shown_right(flight: Flight, vehicle) -> set[str]:
    """The comparisons (`Issue.against`) that a flight without a finding moves enough to fail, and
    passes.
    """
    grid = clock_of(flight)
    if grid is None:
        return set()
    signals = Signals.of(flight, grid)
    shown = {pair.what for pair in pairs_of(signals) if pair.tells.sum() >= min(2, len(pair.tells))}
    torques = _torques(signals, vehicle)
    return shown | ({MOTORS} if torques and torques[IDENTITY][:2].min() > 0.4 else set())


def _contradictions(signals: Signals) -> list[Finding]:
    """The pairs that disagree, or what mends them all; else columns in a wrong unit."""
    pairs = list(pairs_of(signals))
    bad = [pair for pair in pairs if pair.bad.any()]
    if not bad:
        return [finding for pair in pairs for finding in _unit(pair)][:1]
    words = _convention(signals, bad)
    mended = ("axes", words) if words else _mended(signals, bad)
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
    """Kind and words of a convention or labelling of one channel that makes the disagreeing pairs
    agree.
    """
    if signals.quaternion is not None:
        for words, convert in QUATERNIONS.items():
            other = dataclasses.replace(signals, quaternion=convert(signals.quaternion))
            if _agrees(other, bad):
                return "quaternion", words
    if signals.velocity is not None and signals.quaternion is not None:
        world = to_body(signals.quaternion * [1.0, -1.0, -1.0, -1.0], signals.velocity)
        if _agrees(dataclasses.replace(signals, velocity=world), bad):
            return "axes", "vx, vy, vz are in the body frame; the log format wants the world frame"
    for pair in bad:
        if pair.holds and (words := _relabelled(signals, pair, bad)):
            return "axes", words
    if any(pair.holds == "body_rates" for pair in bad):
        for words, attitude in _attitudes(signals):
            if _agrees(dataclasses.replace(signals, quaternion=attitude), bad):
                return "quaternion", words
    return None


def _convention(signals: Signals, bad: list[Pair]) -> str:
    """Of another program's conventions one that makes the disagreeing pairs agree, in words."""
    others = ((c.words, c.convert(signals)) for c in CONVENTIONS)
    return next((w for w, other in others if upright(other) and _agrees(other, bad)), "")


def _attitudes(signals: Signals) -> Iterator[tuple[str, np.ndarray]]:
    """(what is wrong, the attitude (T, 4) without it): the usual conventions, other signs of the
    angles, and any order of the quaternion, where the gyroscope says how it must turn.
    """
    for words, convert in QUATERNIONS.items():
        yield words, convert(signals.quaternion)
    angles = Rotation.from_quat(signals.quaternion, scalar_first=True).as_euler("ZYX")
    for k, name in ((1, "pitch"), (2, "roll"), (0, "yaw")):
        signs = np.where(np.arange(3) == k, -1.0, 1.0)
        mirrored = Rotation.from_euler("ZYX", angles * signs).as_quat(scalar_first=True)
        words = f"{name} has the other sign: scale = -1 for {name} in columns.toml"
        yield f"{words}, or the quaternion of the angle that it should be", mirrored
    for order in itertools.permutations(range(4)):
        for way, sign in (("", 1.0), (" and from world to body", INVERSE)):
            attitude = signals.quaternion[:, order] * sign
            if _turns_with(signals, attitude):
                # quaternion[:, order[i]] is what should stand at i
                held = ", ".join("wxyz"[order.index(i)] for i in range(4))
                yield f"the quaternion is in the order {held}{way}; {WANTED}", attitude


def _turns_with(signals: Signals, attitude: np.ndarray) -> bool:
    """Whether an attitude (T, 4) is upright and turns as the gyroscope says."""
    if rotation(attitude)[:, 2, 2].mean() < UPRIGHT:
        return False
    if signals.body_rates is None:
        return True
    turned = in_band(rates_of(attitude), WIDE)
    felt = in_band(signals.body_rates, WIDE)
    power = max(float(np.sqrt((turned**2).sum() * (felt**2).sum())), 1e-12)
    return float((turned * felt).sum()) > FOLLOWED * power


def _inverted(signals: Signals) -> list[Finding]:
    """What flies by its thrust is upright on the mean."""
    if signals.quaternion is None:
        return []
    upright = float(rotation(signals.quaternion)[:, 2, 2].mean())
    if upright >= UPRIGHT:
        return []
    for words, attitude in _attitudes(signals):
        other = dataclasses.replace(signals, quaternion=attitude)
        if rotation(attitude)[:, 2, 2].mean() > UPRIGHT and _agrees(other, []):
            return [("quaternion", words, ["the attitude's thrust"])]
    text = f"by its attitude the vehicle flies upside down (mean cosine of its tilt {upright:.2f})"
    return [
        ("quaternion", f"{text}: qw, qx, qy, qz hold something else", ["the attitude's thrust"])
    ]


def _paths(signals: Signals) -> Iterator[Finding]:
    """Axes on which the position doesn't move as the velocity says, however slowly."""
    if signals.position is None or signals.velocity is None:
        return
    along = np.cumsum(signals.velocity, 0) / RATE
    for k, axis in enumerate("xyz"):
        gain = _gain(along[:, k], signals.position[:, k])
        back = _gain(signals.position[:, k], along[:, k])
        if gain is not None and not GAINS[0] < gain < GAINS[1]:
            text = f"{axis} moves by {gain:.2f} times what v{axis} adds up to"
        elif back is not None and not 1.0 / GAINS[1] < back < 1.0 / GAINS[0]:
            text = f"v{axis} adds up to {back:.2f} times what {axis} moves by"
        else:
            continue
        yield "garbage", f"contradictory: {text}", ["the position's rate"]


def _gain(path: np.ndarray, other: np.ndarray) -> float | None:
    """How far another path (T,) m moves where this one does, a steady drift aside; None where this
    one hardly moves.
    """
    time = np.arange(len(path)) / RATE
    columns = np.stack([path - path.mean(), time - time.mean()], 1)
    # Errors of a path last: each second says one thing.
    weight = 1.0 / (PATH_ERROR**2 * RATE)
    normal = weight * columns.T @ columns + np.diag([0.0, 1.0 / DRIFT**2])
    moved = normal[0, 0] - normal[0, 1] ** 2 / normal[1, 1]
    if moved * PATH_ERROR**2 < MOVES**2 * len(path) / RATE:
        return None
    return float(np.linalg.solve(normal, weight * columns.T @ (other - other.mean()))[0])


def _relabelled(signals: Signals, pair: Pair, bad: list[Pair]) -> str:
    """Which axes of a pair's channel hold what, if the best of all 48 labellings of it makes the
    disagreeing pairs agree.
    """
    values = getattr(signals, pair.holds)
    names = CHANNEL_COLUMNS.get(pair.holds, CHANNEL_COLUMNS["command_body_rates"])
    best = None
    most = -np.inf
    for order, signs in RELABELLINGS:
        changes = {pair.holds: values[:, order] * signs}
        if pair.holds == "position" and signals.velocity is not None:
            changes["velocity"] = signals.velocity[:, order] * signs
        other = next(
            p for p in pairs_of(dataclasses.replace(signals, **changes)) if p.what == pair.what
        )
        score = float(other.agreement.correlation.sum())
        if score > most + 1e-9:
            best = (order, signs, changes)
            most = score
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
    # noise and an estimator's lag cost correlation, and change a gain of rms values by as much
    clear = pair.tells & (found.correlation > CLEAR)
    if pair.holds != "body_rates" or clear.sum() < 2:
        return []
    gains = found.measured[clear] / found.reference[clear]
    if (gains < SAME).any() and (gains > 1 / SAME).any():
        return []
    text = f"{', '.join(pair.names)} are {np.median(gains):.2g} times {pair.what}"
    return [("units", f"{text}: one of them is something else", [pair.what])]


def _upside_down(signals: Signals) -> list[Finding]:
    """Axes of world and body by which gravity points the right way, and nothing disagrees."""
    if signals.force is None or np.median(signals.force[:, 2]) > 0.0:
        return []
    words = _frames(signals)
    return [("axes", words, ())] if words else []


def other_frames(flight: Flight) -> str:
    """In what other axes of world and body the rows of a flight are, in words; nothing where no
    others agree.
    """
    grid = clock_of(flight)
    return "" if grid is None else _frames(Signals.of(flight, grid))


def _frames(signals: Signals) -> str:
    """See `other_frames`. Without an attitude gravity alone tells, of the body's axes."""
    if signals.quaternion is None and signals.force is None:
        return ""
    for convention in FRAMES if signals.quaternion is not None else (BODY,):
        other = convention.convert(signals)
        if upright(other) and not _gravity(other.force) and _agrees(other, []):
            return convention.words
    return ""


def _gravity(force: np.ndarray | None) -> list[Finding]:
    """A flying quadrotor's specific force points along body z, about 9.81 m/s^2 up, whatever its
    attitude.
    """
    if force is None:
        return []
    mean = np.median(force, 0)
    size = float(np.linalg.norm(mean))
    axis = int(np.argmax(np.abs(mean)))
    unit = "in g" if 0.6 < size < 2.0 else "in thousandths of g" if 600 < size < 2000 else ""
    if unit:
        return [
            ("units", f"ax, ay, az are {unit} (mean {size:.2f}); the log format wants m/s^2", ())
        ]
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
    """Motors in another order or with other spins, or whose torques the body doesn't follow at
    all.
    """
    torques = _torques(s, vehicle)
    if not torques:
        return []
    logged, (rotors, best) = torques[IDENTITY], max(torques.items(), key=lambda item: item[1].sum())
    # The right order explains every axis; an offset mass or weak motor can spoil one or two, and
    # isn't an order.
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
        return [
            (
                "garbage",
                f"contradictory: {MOTORS} against the angular acceleration: {text}",
                [MOTORS],
            )
        ]
    return []


def _torques(s: Signals, vehicle) -> dict[tuple, np.ndarray]:
    """{(order, spin's sign): correlation (3,) of the angular acceleration with the torques that
    motors in this order make}.
    """
    if s.motor is None or s.rates is None:
        return {}
    place = np.asarray(vehicle.rotor_position, float)
    spin = np.asarray(vehicle.rotor_spin, float)
    mixing = np.stack([place[:, 1], -place[:, 0], spin])  # roll, pitch and yaw torque per thrust
    measured = in_band(np.gradient(s.rates, 1 / RATE, axis=0), TURNING)
    lagged = in_band(first_order(s.motor, float(vehicle.motor_time_constant)), TURNING)
    if (lagged.std(0) < 1e-6).all():
        return {}
    # Motors are correlated, so whole torques are scored: by the moments of angular acceleration and
    # motors at each offset.
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
    """Channels without order in time: half the mean square step from row to row is the variance
    itself.
    """
    for channel, least in CONTINUOUS.items():
        if getattr(flight, channel) is None or (channel == "velocity" and flight.velocity_derived):
            continue
        time, values = flight.sampled(channel)
        near = np.diff(time) < 0.03  # s: longer steps say nothing about continuity
        if near.sum() < LEAST_ROWS:
            continue
        spread = values.std(0)
        steps = np.diff(values, axis=0)[near]
        ratio = 0.5 * (steps**2).mean(0) / np.maximum(spread**2, 1e-18)
        bad = (ratio > RANDOM) & (spread > least)
        if bad.any():
            names = ", ".join(n for n, b in zip(CHANNEL_COLUMNS[channel], bad, strict=True) if b)
            yield (
                f"contradictory: the rows of {names} follow each other at random "
                f"({100 * ratio[bad].max():.0f} % of "
                "the variance from one row to the next)"
            )
