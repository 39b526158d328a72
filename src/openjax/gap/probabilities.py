"""How sure the words are: the probability of each cause to be the strongest.

Three uncertainties, each with a number of its own: whether an effect acts (how often its set is chosen, `selection`), whether
what it takes is more than real vehicles without a fault have (`beyond_form_error`), and which part is the largest (the shares'
bootstrap). What remains goes to the sets that were chosen otherwise, to nothing and to the unknown."""

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import CARDS
from openjax.vehicle.effects import EFFECTS


def beyond_form_error(fit: SetFit, effect: str) -> float:
    """Probability that an effect's fitted parameters are more than the form error of a vehicle without a fault: both are normal
    about no effect, with the card's `form_error` and with its prior's spread, and equally likely beforehand."""
    card = CARDS[effect]
    if not card.form_error:
        return 1.0
    found, log_odds = fit.parameters()[effect], 0.0
    spreads = {f.name: np.hypot(f.spread, card.common) for f in card.fitted}
    for name, small in card.form_error.items():
        value, error = found[name]
        away = (value - EFFECTS[effect].parameters[name].none) ** 2
        usual, wide = (s**2 + error**2 for s in (small, spreads[name]))
        log_odds += 0.5 * (away / usual - away / wide + np.log(usual / wide))
    return float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -30.0, 30.0))))


def probabilities(
    present: dict[str, float], beyond: dict[str, float], largest: dict[str, float], unknown: float, weights
) -> dict[str, float]:
    """{cause, "none", "unknown": probability of being the strongest}, whose sum is one.

    present: {named effect: probability that it acts}. beyond: {effect: `beyond_form_error`}. largest: {effect or "unexplained":
    how often it is the largest part}. unknown: probability that what is unexplained is real. weights: {effects: how often that
    set was chosen}."""
    chance = dict.fromkeys((*EFFECTS, "none", "unknown"), 0.0)
    sure = (1.0 - unknown) if present else 1.0
    for effect, p in present.items():
        chance[effect] = p * sure * largest.get(effect, 0.0)
    chance["unknown"] = unknown * (largest.get("unexplained", 0.0) if present else 1.0)
    left = 1.0 - sum(chance.values())
    others = {effects: w for effects, w in weights.items() if not effects & set(present)}
    shared = {"none": 1e-3, **dict.fromkeys(present, 1e-3)}
    for effects, w in others.items():
        for effect in effects or ("none",):
            real = w * beyond.get(effect, 1.0) / max(len(effects), 1)
            shared[effect] = shared.get(effect, 0.0) + real
            shared["none"] += w / max(len(effects), 1) - real
    total = sum(shared.values())
    for name, weight in shared.items():
        chance[name] += left * weight / total
    return tempered(chance, DECISION.temperature)


def tempered(chance: dict[str, float], temperature: float) -> dict[str, float]:
    """Probabilities as sure as they are right in cases with known answers: their logarithms over one temperature (Guo et al.
    2017)."""
    flat = {name: max(p, 0.0) ** (1.0 / temperature) for name, p in chance.items()}
    total = sum(flat.values())
    return {name: p / total for name, p in flat.items()}
