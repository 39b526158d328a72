"""Do a flight's channels agree with each other? What one says, another must show: attitude and
gyroscope, position and velocity, the path's acceleration and the attitude's thrust, the
accelerometer and the path, motors, commands and what follows them. A log whose channels contradict
each other isn't diagnosed, whatever made it: swapped axes, a wrong convention, unit or motor order,
rows out of order, columns of another flight, noise in place of data. Where another labelling or
convention mends a pair, that is what is said.
"""

import dataclasses

import numpy as np

from openjax.flights.flight import Finding, Flight, Issue
from openjax.flights.mending import (
    UPRIGHT,
    agrees,
    attitudes,
    by_conventions,
    convention_of,
    frames_of,
    mend,
)
from openjax.flights.motor_order import MOTORS, order_findings, torques_fit
from openjax.flights.pairs import AGREE, SignalPair, Signals, pairs_of
from openjax.flights.plausible import (
    copied_columns,
    gravity_findings,
    path_findings,
    rows_at_random,
)
from openjax.flights.signals import clock_of
from openjax.flights.track import rotation

UNIT = 2.5  # factor about a unit's, within which a gain is that unit
CLEAR = 0.9  # correlation from which a gain is one, and an attitude the right one
SAME = 1.4  # factor by which two sensors of one rate may differ
BETTER = 0.25  # share of what is left of a correlation, below which one is another's
UNITS = {
    "rad/s": (("deg/s", 180 / np.pi),),
    "m/s": (("mm/s", 1e3),),
    "m/s^2": (("mm", 1e3), ("cm", 1e2)),
}


def check_agreement(flight: Flight, vehicle) -> list[Issue]:
    """Findings on a flight that has passed the other checks (sorted, finite, airborne);
    every one refuses it. `vehicle` gives the rotors' places and spins.
    """
    issues = [("garbage", text, ()) for text in (*copied_columns(flight), *rows_at_random(flight))]
    grid = clock_of(flight)
    if grid is not None and not issues:
        signals = Signals.of(flight, grid)
        issues = (
            _upside_down(signals)
            or gravity_findings(signals.force)
            or _inversions(signals)
            or _contradictions(signals)
            or list(path_findings(signals))
            or order_findings(signals, vehicle)
        )
    return [Issue(flight.name, text, True, kind, tuple(against)) for kind, text, against in issues]


def shown_right(flight: Flight, vehicle) -> set[str]:
    """The comparisons (`Issue.against`) that a flight without a finding moves enough to
    fail, and passes.
    """
    grid = clock_of(flight)
    if grid is None:
        return set()
    signals = Signals.of(flight, grid)
    channels = {
        pair.what for pair in pairs_of(signals) if pair.tells.sum() >= min(2, len(pair.tells))
    }
    return channels | ({MOTORS} if torques_fit(signals, vehicle) else set())


def other_frames(flight: Flight) -> str:
    """In what other axes of world and body the rows of a flight are, in words; nothing
    where no others agree.
    """
    grid = clock_of(flight)
    return "" if grid is None else frames_of(Signals.of(flight, grid))


def _contradictions(signals: Signals) -> list[Finding]:
    """The pairs that disagree, or what mends them all; else columns in a wrong unit."""
    pairs = list(pairs_of(signals))
    bad = [pair for pair in pairs if pair.bad.any()]
    if not bad:
        units = (finding for pair in pairs for finding in _unit(pair))
        return _other_quaternion(signals, pairs) or list(units)[:1]
    words = convention_of(signals, bad)
    mending = ("axes", words) if words else mend(signals, bad)
    if mending is not None:
        return [(*mending, [pair.what for pair in bad])]
    return [("garbage", pair.in_words(), [pair.what]) for pair in bad]


def _other_quaternion(signals: Signals, pairs: list[SignalPair]) -> list[Finding]:
    """A convention of the quaternion by which the attitude turns with the gyroscope so
    much better that it was only the clocks' free offset that let the two agree: a turn
    to and fro, the wrong way round, is the right one half a period later.
    """
    if signals.quaternion is None:
        return []
    turning = [p for p in pairs if p.holds == "body_rates" and p.tells.any()]
    doubtful = [p for p in turning if p.agreement.correlation[p.tells].min() < CLEAR]
    for pair in doubtful:
        misfit = 1.0 - pair.agreement.correlation[pair.tells]
        for words, other in by_conventions(signals):
            follows = next(p for p in pairs_of(other) if p.what == pair.what).agreement
            misfit_of_other = 1.0 - follows.correlation[pair.tells]
            if (misfit_of_other < BETTER * misfit).all() and agrees(other, [pair]):
                return [("quaternion", words, [pair.what])]
    return []


def _unit(pair: SignalPair) -> list[Finding]:
    """Columns of a pair that agrees but for its size, where a wrong unit explains that."""
    agreement = pair.agreement
    follows = (agreement.correlation > AGREE) & (agreement.reference > 1e-9)
    if not follows.any():
        return []
    gain = float(np.median(agreement.signal[follows] / agreement.reference[follows]))
    for unit, factor in UNITS.get(pair.unit, ()):
        for columns, times in ((", ".join(pair.names), gain), (pair.what, 1.0 / gain)):
            if factor / UNIT < times < factor * UNIT:
                logged_unit = "m" if pair.unit == "m/s^2" else pair.unit
                text = (
                    f"{columns}: in {unit} ({times:.0f} times too large); the log "
                    f"format wants {logged_unit}"
                )
                return [("units", text, [pair.what])]
    # noise and an estimator's lag cost correlation, and change a gain of rms values by as much
    clear = pair.tells & (agreement.correlation > CLEAR)
    if pair.holds != "body_rates" or clear.sum() < 2:
        return []
    gains = agreement.signal[clear] / agreement.reference[clear]
    if (gains < SAME).any() and (gains > 1 / SAME).any():
        return []
    text = f"{', '.join(pair.names)} are {np.median(gains):.2g} times {pair.what}"
    return [("units", f"{text}: one of them holds something else", [pair.what])]


def _inversions(signals: Signals) -> list[Finding]:
    """Check that the vehicle is upright on the mean, as anything that flies by its thrust is."""
    if signals.quaternion is None:
        return []
    upright = float(rotation(signals.quaternion)[:, 2, 2].mean())
    if upright >= UPRIGHT:
        return []
    for words, attitude in attitudes(signals):
        other = dataclasses.replace(signals, quaternion=attitude)
        if rotation(attitude)[:, 2, 2].mean() > UPRIGHT and agrees(other, []):
            return [("quaternion", words, ["the attitude's thrust"])]
    text = f"by its attitude the vehicle flies upside down (mean cosine of its tilt {upright:.2f})"
    return [
        ("quaternion", f"{text}: qw, qx, qy, qz hold something else", ["the attitude's thrust"])
    ]


def _upside_down(signals: Signals) -> list[Finding]:
    """Axes of world and body by which gravity points the right way, and nothing disagrees."""
    if signals.force is None or np.median(signals.force[:, 2]) > 0.0:
        return []
    words = frames_of(signals)
    return [("axes", words, ())] if words else []
