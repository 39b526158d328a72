"""How sure the words are: the probability of each cause to be the strongest one."""

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
SURE = 0.97  # no name is more certain than this


def probabilities_of(
    evidence: Evidence, selection: Selection, parts: Split, rest: Rest, effects
) -> dict[str, float]:
    """How likely each is the strongest cause. Shares say which of the named is the largest; what would do nearly as
    well in a name's place, or was nearly accepted, takes what its likelihood leaves it."""
    weights = dict.fromkeys(EFFECTS, 0.0) | dict.fromkeys(
        (*evidence.library.effects, "none", "unknown"), 1e-6
    )
    if effects:
        strength = {
            e: max(parts.unexplained.value if e == "unknown" else parts.effects[e].value, 0.02)
            for e in effects
        }
        strength |= {"unknown": max(strength.get("unknown", 0.0), 0.1)} if "unknown" in effects else {}
        for effect, share in strength.items():
            weights[effect] += share**3
            for other, nats in selection.swaps.get(effect, {}).items():
                weights[other] += share**3 * float(np.exp(min(nats / TEMPERATURE, 0.0)))
        margin = min((selection.gains[e].nats for e in effects if e in selection.gains), default=1e3)
        weights["none"] += weights[effects[0]] * float(np.exp(-max(margin, 0.0) / TEMPERATURE))
    else:
        weights["none"] = 1.0
        for effect, gain in selection.offered.items():
            nearly = min(max(gain.floors / LEAST_GAIN, 0.0), 1.0) ** 2
            weights[effect] += (
                0.5 * nearly * float(np.exp(min((gain.nats - 2 * LEAST_NATS) / TEMPERATURE, 0.0)))
            )
        if selection.offered:
            weights["unknown"] += 0.5 * min(float(rest.predicted.max()) / FOLLOWED, 1.0) ** 2
    doubt = 1.0 - SURE
    total = sum(weights.values())
    chance = {k: SURE * v / total for k, v in weights.items()}
    first = effects[0] if effects else "none"
    chance["unknown" if first != "unknown" else "none"] += doubt
    if max(chance, key=chance.get) != first:  # the first word is the most probable
        top = max(chance, key=chance.get)
        chance[first], chance[top] = chance[top], chance[first]
    return chance
