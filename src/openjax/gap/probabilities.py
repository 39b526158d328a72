"""How sure the words are: the probability of each cause to be the strongest one.

A name is as certain as what its effect takes off the gap: half where that is no more than what forms, filters and rows of a
log commonly have wrong, nearly sure where it is many times that. Where nothing is named, something small or
hidden acts more often than one would think. The numbers are round, and were set on four worlds that share no code at all
or none but the sensors: two seeds of the exam's known column, RotorPy and the second plant.
"""

from __future__ import annotations

import numpy as np

from openjax.gap.evidence import Evidence
from openjax.gap.rest import Rest
from openjax.gap.selection import LEAST_GAIN, LEAST_NATS, Selection
from openjax.gap.shares import Split
from openjax.vehicle.effects import EFFECTS

FOLLOWED = 0.2  # of a channel's rest that follows something in the log: something is left to explain
TEMPERATURE = (
    4.0  # divides differences of log-likelihood: residuals are never quite as independent as they count
)
SURE = 0.92  # no name by its gain is more certain than this
HALF = 0.07  # floors that a name takes off the gap if it is half as certain
READ = 0.97  # certainty of what radio, rate loop and pose say: they have bounds of their own
SEEN = 0.9  # certainty of "unknown" where a sensor is off or the rest has a rhythm
LEFT = 0.6  # the most where something is left that follows the log
NOTHING = 0.68  # certainty of "none"
BROAD = 3.0  # by which a share's power makes the largest the strongest


def probabilities_of(
    evidence: Evidence, selection: Selection, parts: Split, rest: Rest, effects
) -> dict[str, float]:
    """{cause, "none", "unknown": probability}, whose sum is one and whose largest is the first word."""
    names = dict.fromkeys((*evidence.library.effects, "none", "unknown"), 0.0)
    if not effects:
        chance = {"none": NOTHING}
    else:
        sure = {e: _certainty(evidence, selection, parts, rest, e) for e in effects}
        power = {e: max(_share(parts, e), 0.02) ** BROAD for e in effects}
        total = sum(power.values())
        chance = {e: sure[e] * power[e] / total for e in effects}
    doubt = 1.0 - sum(chance.values())
    chance = names | chance
    others = _alternatives(evidence, selection, rest, effects)
    total = sum(others.values())
    for name, weight in others.items():
        chance[name] += doubt * weight / total
    return dict.fromkeys(EFFECTS, 0.0) | _first_on_top(chance, effects[0] if effects else "none")


def _share(parts: Split, effect: str) -> float:
    return parts.unexplained.value if effect == "unknown" else parts.effects[effect].value


def _certainty(evidence: Evidence, selection: Selection, parts: Split, rest: Rest, effect: str) -> float:
    if effect == "unknown":
        if rest.local or set(evidence.sensors.findings) - {"clocks"}:
            return SEEN
        return LEFT * _by_size(parts.gap.after - 1.0)
    if effect in selection.gains:
        return SURE * _by_size(selection.gains[effect].floors)
    return READ


def _by_size(floors: float) -> float:
    square = max(floors, 0.0) ** 2
    return square / (square + HALF**2)


def _alternatives(evidence: Evidence, selection: Selection, rest: Rest, effects) -> dict[str, float]:
    """Weights of what it may be instead: what does nearly as well in a name's place or was nearly accepted, nothing at
    all, something unknown."""
    weights = dict.fromkeys(evidence.library.effects, 0.01)
    for effect in effects:
        for other, nats in selection.swaps.get(effect, {}).items():
            weights[other] += float(np.exp(min(nats / TEMPERATURE, 0.0)))
    for effect, gain in selection.offered.items():
        nearly = min(max(gain.floors / LEAST_GAIN, 0.0), 1.0) ** 2
        weights[effect] += nearly * float(np.exp(min((gain.nats - 2 * LEAST_NATS) / TEMPERATURE, 0.0)))
    weights["unknown"] = (
        0.5 if effects else 0.5 + min(float(rest.strange.predicted.max()) / FOLLOWED, 1.0) ** 2
    )
    weights["none"] = 0.5
    return {e: w for e, w in weights.items() if e not in effects and (effects or e != "none")}


def _first_on_top(chance: dict[str, float], first: str) -> dict[str, float]:
    """The probabilities with none above that of the first word: what is too much goes to all others alike."""
    for _ in range(len(chance)):
        top = max(chance, key=lambda e: chance[e])
        over = chance[top] - 0.99 * chance[first]
        if top == first or over <= 0.0:
            return chance
        chance[top] -= over
        below = [e for e in chance if e != top and chance[e] < 0.99 * chance[first]] or [first]
        for e in below:
            chance[e] += over / len(below)
    return chance
