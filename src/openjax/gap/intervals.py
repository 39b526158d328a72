"""Parameters of the named effects with their 90 % intervals.

An interval is the fit's, or what flights disagree by where that is more, and never narrower than what forms that aren't
quite the library's leave: some per cent of the effect."""

import numpy as np

from openjax.gap.channels import robust_deviation
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import CARDS, PLACE, path_of
from openjax.gap.report import Estimate
from openjax.vehicle.effects import EFFECTS

REACH = 1.645  # standard deviations of a 90 % interval


def estimates(evidence: Evidence, fit: SetFit, named) -> dict[str, dict[str, Estimate]]:
    """{effect: {parameter: its estimate}} of the named effects."""
    out = {}
    deviation = dict(
        zip(fit.index.tolist(), robust_deviation(fit.covariance, fit.grams[:, 1:, 0]), strict=True)
    )
    for effect in named:
        out[effect] = {}
        physics = path_of(effect) == "physics"
        sizes = _sizes(effect, fit.theta) if physics else {}
        for fitted in CARDS[effect].fitted:
            parameter = EFFECTS[effect].parameters[fitted.name]
            if physics:
                place = PLACE[effect, fitted.name]
                value = float(fit.theta[place])
                low = high = float(
                    np.linalg.norm((deviation[place], DECISION.form_error * sizes[fitted.name], fitted.error))
                )
            else:
                channel = next(c for c in evidence.channels if c.path == path_of(effect))
                told = channel.estimate(effect, fitted.name)
                value, low, high = told.value, told.below, told.above
            out[effect][fitted.name] = Estimate(
                value, parameter.unit, (value - REACH * low, value + REACH * high), parameter.prior
            )
    return out


def _sizes(effect: str, theta: np.ndarray) -> dict[str, float]:
    """{parameter: how far the effect's parameters of its unit are from absent, the furthest of them}."""
    parameters = EFFECTS[effect].parameters
    away = {
        f.name: abs(float(theta[PLACE[effect, f.name]]) - parameters[f.name].none)
        for f in CARDS[effect].fitted
    }
    return {
        name: max(v for other, v in away.items() if parameters[other].unit == parameters[name].unit)
        for name in away
    }
