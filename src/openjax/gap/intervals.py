"""Parameters of the named effects with their 90 % intervals."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit
from openjax.gap.library import CARDS, PLACE, path_of
from openjax.gap.report import Estimate
from openjax.vehicle.effects import EFFECTS

LEAST_ERROR = 0.01  # of a value, one standard deviation


def estimates(evidence: Evidence, fit: SetFit, named) -> dict[str, dict[str, Estimate]]:
    """Parameters of the named effects with 90 % intervals, from the model or, where they disagree more, from the
    flights' own spread."""
    out = {}
    deviation = robust_deviation(fit)
    for effect in named:
        path = path_of(effect)
        values = {}
        for number, fitted in enumerate(CARDS[effect].fitted):
            parameter = EFFECTS[effect].parameters[fitted.name]
            if path == "physics":
                place = PLACE[effect, fitted.name]
                value, spread = float(fit.theta[place]), float(deviation[list(fit.index).index(place)])
                # The replay itself is no better than that.
                spread = float(np.hypot(spread, LEAST_ERROR * value))
            else:
                value, spread = _path_estimate(evidence, effect, number)
            reach = 1.645 * spread
            values[fitted.name] = Estimate(
                value, parameter.unit, (value - reach, value + reach), parameter.prior
            )
        out[effect] = values
    return out


def robust_deviation(fit: SetFit) -> np.ndarray:
    """Standard deviations (p,) of a fit's parameters: flight-wise sandwich where flights disagree more
    than they should."""
    model = np.sqrt(np.diag(fit.covariance))
    count = len(fit.grams)
    if count < 2 or not len(fit.index):
        return model
    pushes = fit.grams[:, 1:, 0] - fit.grams[:, 1:, 0].mean(0)
    middle = pushes.T @ pushes * count / (count - 1)
    sandwich = np.sqrt(np.maximum(np.diag(fit.covariance @ middle @ fit.covariance), 0.0))
    # Few flights: Student's quantile instead of the normal one.
    sandwich *= student.ppf(0.95, count - 1) / 1.645
    return np.clip(sandwich, model, 4.0 * model)


def _path_estimate(evidence: Evidence, effect: str, number: int) -> tuple[float, float]:
    if effect == "state_latency":
        _, theta, covariance = evidence.pose.score()
        return float(theta[0]), float(np.sqrt(covariance[0, 0]))
    if effect == "rate_gains":
        return 1.0 + float(evidence.gains.change[number]), float(evidence.gains.error[number])
    radio = evidence.radio
    if effect == "command_latency":
        return radio.delay, 0.0005
    n = max(radio.informative, 1)
    return radio.loss, float(np.sqrt(radio.loss * (1 - radio.loss) / n) + 0.5 / n)
