"""From gains and shares to words and probabilities: what is named, what is left, what couldn't be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.gap.evidence import Evidence
from openjax.gap.library import path_of
from openjax.gap.probabilities import FOLLOWED, TEMPERATURE, probabilities_of
from openjax.gap.rest import Followed, Rest
from openjax.gap.selection import LEAST_GAIN, LEAST_NATS, LEAST_SHARE, TESTABLE, Selection
from openjax.gap.shares import Split

CLOCK = 0.003  # s by which the clocks of a log may differ
CLEAR = 3.0  # standard errors
LEAST_COUNTED = 100.0  # nats of the link alone that need no share
LEAST_LOSS = 0.005  # of the packets
BESIDE = 0.13  # floors by which an effect must shrink the gap to be named beside a stronger one
LEAST_LEFT = 0.05  # floors of the gap that a strange rest must hold to be named: the best of many regressors
LEAST_PLAIN = 0.01  # the same where plain ones tell it
LEAST_LARGE = 0.25  # the same of a rest that an effect of the list could make, and none was named
UNDONE = 1.5  # sum of the shares beyond which effects undo each other
UNKNOWN_SHARE = 0.08  # of the gap, from which a strange rest is named beside the effects
LARGE_SHARE = 0.2  # the same of any rest


@dataclass(frozen=True)
class Verdict:
    """`word` of report.VERDICTS; `effects` by share, "unknown" among them where the rest is material."""

    word: str
    effects: tuple[str, ...]
    probabilities: dict[str, float]


def other_paths(evidence: Evidence) -> list[str]:
    """Effects of radio, rate loop and pose that the log shows."""
    found, known = [], evidence.library.effects
    radio = evidence.radio
    if radio is not None:
        key = radio.shown(known, CLOCK, LEAST_LOSS, LEAST_NATS)
        found += [n for n in key if radio.gain[key] - radio.gain[_less(key, n)] > LEAST_NATS * TEMPERATURE]
    if evidence.gains is not None and "rate_gains" in known and evidence.gains.clear:
        found.append("rate_gains")
    if evidence.pose is not None and "state_latency" in known:
        nats, delay, covariance = evidence.pose.score()
        unsure = CLOCK + max(t.pose_age for t in evidence.tracks) + evidence.sensors.wander
        if nats > LEAST_NATS and delay[0] > max(unsure, CLEAR * float(np.sqrt(covariance[0, 0]))):
            found.append("state_latency")
    return found


def shrinks(parts: Split, effect: str) -> bool:
    """Whether an effect of the rate loop shrinks the gap: its gains may be read more finely than it matters."""
    if path_of(effect) != "rate_loop":
        return True
    whole = max(parts.gap.before**2 - 1.0, 0.0)
    return parts.effects[effect].value * whole > (1.0 + LEAST_GAIN) ** 2 - 1.0


def _less(key: tuple[str, ...], name: str) -> tuple[str, ...]:
    return tuple(n for n in key if n != name)


def not_testable(evidence: Evidence) -> list[str]:
    """Effects of the library that, at a usual size, these flights would not show."""
    physics, exposure = evidence.library.physics, evidence.exposure
    missing = [e for e in physics if e in evidence.feigned or exposure.get(e, 0.0) < TESTABLE]
    if evidence.radio is None or evidence.radio.informative < 30 or not evidence.radio.readable:
        missing += [e for e in ("command_latency", "packet_loss") if e in evidence.library.effects]
    if evidence.gains is None or not evidence.gains.readable:
        missing += [e for e in ("rate_gains",) if e in evidence.library.effects]
    if evidence.pose is None:
        missing += [e for e in ("state_latency",) if e in evidence.library.effects]
    return missing


def decide(evidence: Evidence, selection: Selection, rest: Rest, parts: Split, missing) -> Verdict:
    """The words that the shares give, and how sure they are."""
    named = _material(evidence, selection, parts)
    strange = bool(set(evidence.sensors.findings) - {"clocks"}) or bool(rest.local)
    largest = max((parts.effects[e].value for e in named), default=0.0)
    routes = (
        (rest.others, LEAST_LEFT if named else LEAST_LARGE, LARGE_SHARE),
        # What is larger than all that is named isn't what its form has wrong.
        (rest.everything, LEAST_LEFT if named else LEAST_LARGE, max(LARGE_SHARE, largest)),
        (rest.strange, LEAST_LEFT, UNKNOWN_SHARE),
        (rest.plain, LEAST_PLAIN, UNKNOWN_SHARE),
    )
    strange = strange or any(
        found.nats > LEAST_NATS
        and found.predicted.max() > FOLLOWED
        and _left(parts, found, least, share, named)
        for found, least, share in routes
    )
    effects = list(named)
    if strange:
        sizes = [parts.effects[e].value for e in named]
        place = int(np.searchsorted(-np.array(sizes), -parts.unexplained.value)) if sizes else 0
        effects.insert(place, "unknown")
    if not named:
        word = "unknown" if strange else "none"
    else:
        word = "unknown" if effects[0] == "unknown" else "effect"
    if word == "none" and len(missing) >= len(evidence.library.effects) // 2:
        word = "not_testable"
    return Verdict(word, tuple(effects), probabilities_of(evidence, selection, parts, rest, effects))


def _left(parts: Split, found: Followed, least: float, least_share: float, named) -> bool:
    """Whether what is found is material: of the gap by itself and, beside names, as a share of it."""
    more = float(np.sum(1.0 / (1.0 - found.predicted) - 1.0)) / len(parts.channels)  # of the gap's square
    share = parts.unexplained.value * min(more / max(parts.gap.after**2 - 1.0, 1e-9), 1.0)
    return np.sqrt(1.0 + more) > 1.0 + least and (not named or share > least_share)


def _material(evidence: Evidence, selection: Selection, parts: Split) -> list[str]:
    """The effects by their share, without those that are small beside the largest: they are what its form has wrong."""
    order = sorted(parts.effects, key=lambda e: -parts.effects[e].value)
    if sum(part.value for part in parts.effects.values()) > UNDONE:
        # What each adds where the others may follow orders them then.
        order.sort(key=lambda e: -selection.gains[e].floors if e in selection.gains else -np.inf)

    def stays(effect: str) -> bool:
        if effect in selection.gains:
            return selection.gains[effect].floors >= BESIDE
        if path_of(effect) != "radio" or parts.effects[effect].value >= LEAST_SHARE:
            return True
        # Lost packets that hold the old command are counted, however little they did to the thrust. Beside a latency late
        # rows look like them, unless a row holds one command only.
        radio = evidence.radio
        feigned = effect == "packet_loss" and radio.delay > CLOCK and not radio.single
        return radio.gain[effect,] > LEAST_COUNTED and not feigned

    if order and parts.effects[order[0]].value < LEAST_SHARE and parts.unexplained.value > UNKNOWN_SHARE:
        return []
    return [e for k, e in enumerate(order) if k == 0 or stays(e)]
