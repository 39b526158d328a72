"""Parameters of the named effects with their 90 % intervals.

An interval is the fit's, or what flights disagree by where that is more, and never narrower than what forms that aren't
quite the library's and rows that show half of what happened leave: some per cent of the effect."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit
from openjax.gap.library import CARDS, PLACE, path_of
from openjax.gap.report import Estimate
from openjax.vehicle.effects import EFFECTS

REACH = 1.645  # standard deviations of a 90 % interval
FORM = 0.05  # of an effect's size, one standard deviation: real effects don't have the library's form
LEAST_ERROR = 0.01  # of a value that isn't zero without the effect
LAG_ERROR = 0.001  # s, of a motor's lag: what the half-known commands inside a row leave
GRID_ERROR = 0.0005  # s, of a command's delay: it is read on a grid of a millisecond
ROW_ERROR = (0.1, 0.29)  # of a row, likewise: rows that are means, rows that are single samples
BURSTS = 3.0  # packets that are lost together
GYROSCOPE_LATE = (
    0.0028  # s by which a low-pass of second order at 80 Hz holds a gyroscope back: sqrt(2) / (2 pi 80 Hz)
)


def estimates(evidence: Evidence, fit: SetFit, named) -> dict[str, dict[str, Estimate]]:
    """{effect: {parameter: its estimate}} of the named effects."""
    out = {}
    deviation = dict(zip(fit.index.tolist(), robust_deviation(fit), strict=True))
    for effect in named:
        out[effect] = {}
        physics = path_of(effect) == "physics"
        sizes = _sizes(effect, fit.theta) if physics else {}
        for number, fitted in enumerate(CARDS[effect].fitted):
            parameter = EFFECTS[effect].parameters[fitted.name]
            if physics:
                place = PLACE[effect, fitted.name]
                value = float(fit.theta[place])
                own = (deviation[place], FORM * sizes[fitted.name], LEAST_ERROR * value)
                lag = LAG_ERROR if effect == "motor_lag" else 0.0
                low = high = float(np.linalg.norm([*own, lag]))
            else:
                value, low, high = _path_estimate(evidence, effect, number)
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
    sandwich *= student.ppf(0.95, count - 1) / REACH
    return np.clip(sandwich, model, 4.0 * model)


def _path_estimate(evidence: Evidence, effect: str, number: int) -> tuple[float, float, float]:
    """Value and standard deviations below and above it."""
    if effect == "state_latency":
        _, theta, covariance = evidence.pose.score()
        spread = float(np.sqrt(covariance[0, 0]))
        # The delay is against the gyroscope, and a gyroscope may be late itself.
        return float(theta[0]), spread, spread + GYROSCOPE_LATE / REACH
    if effect == "rate_gains":
        change, error = (float(v[number]) for v in evidence.gains.found)
        return 1.0 + change, error, error
    radio = evidence.radio
    if effect == "command_latency":
        sampled = any(n.startswith("motors within a row") for n in evidence.replay.nuisance_names)
        spread = float(np.hypot(GRID_ERROR, ROW_ERROR[sampled] * max(t.dt for t in evidence.tracks)))
        return radio.delay, spread, spread
    n = max(radio.told / BURSTS, 1.0)
    spread = float(np.sqrt(radio.loss * (1 - radio.loss) / n) + 0.5 / n)
    return radio.loss, spread, spread
