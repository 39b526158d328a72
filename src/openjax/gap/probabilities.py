"""The probability of each cause to be the strongest.

Two uncertainties, each with a number of its own: whether an effect acts (how often its
set is chosen, `selection`), and which part is the largest (the shares' bootstrap). What
remains goes to sets chosen otherwise, to nothing and to the unknown.
"""

from collections.abc import Collection

from openjax.gap.decision import DECISION
from openjax.vehicle.effects import EFFECTS


def probabilities(
    present, largest, unknown: float, weights, possible: Collection[str] = tuple(EFFECTS)
) -> dict[str, float]:
    """{cause, "none", "unknown": probability of being the strongest}, whose sum is one.

    present: {named effect: probability that it acts}. largest: {effect or
    "unexplained": how often it is the largest part}. unknown: probability that what is
    unexplained is real. weights: {effects: how often that set was chosen}. possible:
    effects that may act; a mass that was weighed may not.
    """
    chance = dict.fromkeys((*EFFECTS, "none", "unknown"), 0.0)
    sure = (1.0 - unknown) if present else 1.0
    for effect, p in present.items():
        chance[effect] = p * sure * largest.get(effect, 0.0)
    chance["unknown"] = unknown * (largest.get("unexplained", 0.0) if present else 1.0)
    rest = 1.0 - sum(chance.values())
    # a little for each: what is left goes somewhere, too, where no draw chose otherwise
    share_of = {"none": 1e-3, **dict.fromkeys(present, 1e-3)}
    for effects, w in weights.items():
        if not effects & set(present):
            others = effects or {"none"}
            share_of |= {e: share_of.get(e, 0.0) + w / len(others) for e in others}
    total = sum(share_of.values())
    for name, weight in share_of.items():
        chance[name] += rest * weight / total
    return reliable(chance, DECISION.reliability, {*possible, "none", "unknown"})


def reliable(chance: dict[str, float], share: float, causes: Collection[str]) -> dict[str, float]:
    """Probabilities of a choice that is right in no more than a `share` of the cases,
    however often draws repeat it: what is left goes to all `causes` alike.
    """
    each = (1.0 - share) / len(causes)
    return {name: share * p + each * (name in causes) for name, p in chance.items()}


def alike(chance: dict[str, float]) -> float:
    """The probability that a choice which is wrong leaves each cause."""
    return (1.0 - DECISION.reliability) / len(chance)


def agreeing(
    chance: dict[str, float], answers, sure: float, no_gap: float = 1.0
) -> dict[str, float]:
    """Probabilities that agree with the words `answers`. Where draws of blocks choose
    nothing, though a share's interval begins at `sure` or the probability of no gap at
    all is `no_gap`, they say that an effect is weak in some flights, not that none acts.
    What isn't named is at most as likely as what is.
    """
    chance = dict(chance)
    answer = max(answers, key=lambda name: chance[name])
    beside = DECISION.none_beside if sure > DECISION.most_of_gap else 1.0
    most = max(min(no_gap, beside), alike(chance))
    if chance["none"] > most:
        chance[answer] += chance["none"] - most
        chance["none"] = most
    for rival in sorted(set(chance) - set(answers), key=lambda name: -chance[name]):
        if chance[rival] <= chance[answer]:
            break
        chance[rival] = chance[answer] = 0.5 * (chance[rival] + chance[answer])
    return chance
