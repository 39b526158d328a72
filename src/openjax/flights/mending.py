"""A search for the axes, convention or labelling of a channel that makes contradicting channels
agree.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from openjax.flights.conventions import BODY, CONVENTIONS, FRAMES, upright
from openjax.flights.flight import CHANNEL_COLUMNS
from openjax.flights.pairs import WIDE, SignalPair, Signals, pairs_of
from openjax.flights.plausible import gravity_findings
from openjax.flights.signals import in_band, rates_of
from openjax.flights.track import rotation, to_body

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
# correlation of turning and gyroscope from which an attitude is tried in full
FOLLOWED = 0.7


def agrees(signals: Signals, bad: list[SignalPair]) -> bool:
    """True if with other `signals` no pair disagrees, and the `bad` ones clearly fit."""
    pairs = {pair.what: pair for pair in pairs_of(signals)}
    return all(pair.what in pairs and pairs[pair.what].fits for pair in bad) and not any(
        pair.bad.any() for pair in pairs.values()
    )


def mend(signals: Signals, bad: list[SignalPair]) -> tuple[str, str] | None:
    """Kind and words of a convention or labelling of one channel that makes the
    disagreeing pairs agree.
    """
    if signals.quaternion is not None:
        for words, other in by_conventions(signals):
            if agrees(other, bad):
                return "quaternion", words
    if signals.velocity is not None and signals.quaternion is not None:
        world = to_body(signals.quaternion * [1.0, -1.0, -1.0, -1.0], signals.velocity)
        if agrees(dataclasses.replace(signals, velocity=world), bad):
            return (
                "axes",
                "vx, vy, vz are in the body frame; the log format wants the world frame",
            )
    for pair in bad:
        if pair.holds and (words := _relabel(signals, pair, bad)):
            return "axes", words
    if any(pair.holds == "body_rates" for pair in bad):
        for words, attitude in attitudes(signals):
            if agrees(dataclasses.replace(signals, quaternion=attitude), bad):
                return "quaternion", words
    return None


def convention_of(signals: Signals, bad: list[SignalPair]) -> str:
    """Of another program's conventions one that makes the disagreeing pairs agree, in words."""
    others = ((c.words, c.convert(signals)) for c in CONVENTIONS)
    return next((w for w, other in others if upright(other) and agrees(other, bad)), "")


def by_conventions(signals: Signals) -> Iterator[tuple[str, Signals]]:
    """(what is wrong, the signals without it) by each usual convention of the quaternion."""
    for words, convert in QUATERNIONS.items():
        attitude = convert(signals.quaternion)
        yield words, dataclasses.replace(signals, quaternion=attitude)


def attitudes(signals: Signals) -> Iterator[tuple[str, np.ndarray]]:
    """(what is wrong, the attitude (T, 4) without it): the usual conventions, other signs of the
    angles, and any order of the quaternion, where the gyroscope says how it must turn.
    """
    for words, convert in QUATERNIONS.items():
        yield words, convert(signals.quaternion)
    angles = Rotation.from_quat(signals.quaternion, scalar_first=True).as_euler("ZYX")
    for k, name in ((1, "pitch"), (2, "roll"), (0, "yaw")):
        signs = np.where(np.arange(3) == k, -1.0, 1.0)
        mirror_image = Rotation.from_euler("ZYX", angles * signs).as_quat(scalar_first=True)
        words = f"{name} has the other sign: scale = -1 for {name} in columns.toml"
        yield f"{words}, or the quaternion of the angle that it should be", mirror_image
    for order in itertools.permutations(range(4)):
        for way, sign in (("", 1.0), (" and from world to body", INVERSE)):
            attitude = signals.quaternion[:, order] * sign
            if _turns_with(signals, attitude):
                # quaternion[:, order[i]] is what should stand at i
                order_words = ", ".join("wxyz"[order.index(i)] for i in range(4))
                yield (f"the quaternion is in the order {order_words}{way}; {WANTED}", attitude)


def _turns_with(signals: Signals, attitude: np.ndarray) -> bool:
    """True if an attitude (T, 4) is upright and turns as the gyroscope says."""
    if rotation(attitude)[:, 2, 2].mean() < UPRIGHT:
        return False
    if signals.body_rates is None:
        return True
    attitude_rates = in_band(rates_of(attitude), WIDE)
    gyroscope_rates = in_band(signals.body_rates, WIDE)
    power = max(float(np.sqrt((attitude_rates**2).sum() * (gyroscope_rates**2).sum())), 1e-12)
    return float((attitude_rates * gyroscope_rates).sum()) > FOLLOWED * power


def _relabel(signals: Signals, pair: SignalPair, bad: list[SignalPair]) -> str:
    """The axes of a pair's channel under the best of all 48 labellings, if that makes the
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
        # of labellings that fit alike the first stays, whatever rounding says
        if score > most + 1e-9:
            best = (order, signs, changes)
            most = score
    order, signs, changes = best
    if not agrees(dataclasses.replace(signals, **changes), bad):
        return ""
    # values[:, order[i]] is what column i should hold
    axis_words = {order[i]: f"{'minus ' if signs[i] < 0 else ''}{'xyz'[i]}" for i in range(3)}
    words = ", ".join(
        f"{names[k]} holds {axis_words[k]}" for k in range(3) if axis_words[k] != "xyz"[k]
    )
    return f"{pair.holds.replace('_', ' ')} axes: {words}, by {pair.what}"


def frames_of(signals: Signals) -> str:
    """In what other axes of world and body signals are, in words; nothing where no
    others agree. Without an attitude gravity alone tells, of the body's axes.
    """
    if signals.quaternion is None and signals.force is None:
        return ""
    for convention in FRAMES if signals.quaternion is not None else (BODY,):
        other = convention.convert(signals)
        if upright(other) and not gravity_findings(other.force) and agrees(other, []):
            return convention.words
    return ""
