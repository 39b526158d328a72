"""By what sets of effects are told apart: how much better one predicts than another,
whether the difference matters, and whether an effect can be, and is of a size that
counts.
"""

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from openjax.gap.channels import of_flights
from openjax.gap.decision import DECISION
from openjax.gap.identification.quantities import REACH
from openjax.gap.model.cross_validation import Validation
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import CARDS, PLACE
from openjax.gap.shapes import Squares

# Nats that an effect of usual size must promise: its gain is then expected at two
# standard errors, as the gain of a true effect is half the square of what it does, and
# its standard error that square's root.
DETECTABLE = 2.0 * DECISION.standard_errors**2


def difference(better: Validation, other: Validation) -> tuple[float, float, float]:
    """By how much the log density of one hypothesis exceeds another's on stretches left
    out, the standard error, and which share of its square white residuals would leave.

    Given what the two predict, only noise is random: its variance is that of white
    residuals or, where that is more, what the residuals of the better one show block by
    block (cluster-robust, Liang and Zeger 1986). So an effect that acts in one block in
    ten is judged by that block.
    """
    change = other.residuals - better.residuals
    cross = np.add.reduceat(change * better.residuals, better.starts)
    energy = np.add.reduceat(change * change, better.starts)
    square = max(float((cross**2).sum()), float(energy.sum()), 1e-12)
    return (float((cross + 0.5 * energy).sum()), square**0.5, float(energy.sum()) / square)


def worse(gain, error, squares: Squares, best: Float[np.ndarray, " channels"]):
    """(...) whether sets are clearly worse than the best one: by so many nats `gain` with their
    standard `error`, and by a gap, of `squares` (..., channels), that is larger by what matters
    of what the best one leaves: not of what no effect does, since one that is large would hide
    all others.
    """
    growth = np.sqrt((squares / best).mean(-1)) - 1.0
    matters = growth > DECISION.least_gap
    return (gain > DECISION.standard_errors * error) & matters


def log_odds(effects) -> float:
    """The log prior odds of a set of effects."""
    return sum(CARDS[e].log_odds for e in effects)


def practical(fit: SetFit) -> bool:
    """True if every effect of a set is clearly of a size that matters in practice."""
    return not too_small(fit)


def too_small(fit: SetFit) -> tuple[str, ...]:
    """The effects of a set that aren't clearly of a size that matters in practice (a
    region of practical equivalence on the parameters, Kruschke 2018). What other
    estimators named is.
    """

    def of_a_size(effect: str) -> bool:
        card = CARDS[effect]
        parameters = [p for p in card.fitted if card.departure or p.practical is not None]
        if not parameters or effect in fit.replay.other_sizes:
            return True
        indices = [PLACE[effect, p.name] for p in parameters]
        shape = [PLACE[effect, p.name] for p in card.fitted if p.shape]
        free = np.flatnonzero(~np.isin(fit.index, shape))
        covariance = of_flights(
            np.linalg.inv(fit.hessian[np.ix_(free, free)]), fit.grams[:, 1:, 0][:, free]
        )
        place = {i: k for k, i in enumerate(fit.index[free].tolist())}
        rows = [place[i] for i in indices]
        away = fit.theta[indices] - fit.replay.absent[indices]
        if card.departure:
            return departs(away, covariance[np.ix_(rows, rows)], card.departure())
        least = np.array([p.practical for p in parameters])
        least = least * fit.replay.size_factors[indices]
        return clearly_larger(away, covariance[np.ix_(rows, rows)], least)

    return tuple(e for e in fit.effects if not of_a_size(e))


def clearly_larger(
    away: Float[np.ndarray, " own"],
    covariance: Float[np.ndarray, "own own"],
    least: Float[np.ndarray, " own"],
) -> bool:
    """True if parameters that are `away` (p,) from doing nothing are further than
    `least` (p,), either one of them by its 90 % interval, or all together by as much of
    their size as their common 90 % region leaves: of two that only their sum is known
    of, neither need be clear by itself.
    """
    deviation = np.sqrt(np.diag(covariance))
    if (np.abs(away) - REACH * deviation > least).any():
        return True
    square = float(away @ np.linalg.solve(covariance, away))
    remaining = 1.0 - np.sqrt(chi2.ppf(0.9, len(away)) / max(square, 1e-12))
    return bool(remaining * np.max(np.abs(away) / least) > 1.0)


def departs(
    away: Float[np.ndarray, " own"],
    covariance: Float[np.ndarray, "own own"],
    departure: Float[np.ndarray, "states own"],
) -> bool:
    """True if parameters that are `away` (p,) from doing nothing do clearly more than
    what begins to matter: what they do, less as much of it as its 90 % region leaves,
    is above 1 (see `Card.departure`).
    """
    directions, scales, _ = np.linalg.svd(departure, full_matrices=False)
    directions = directions[:, scales > 1e-9 * scales[0]]
    effect = directions.T @ departure @ away
    spread = directions.T @ departure @ covariance @ departure.T @ directions
    square = float(effect @ np.linalg.solve(spread, effect))
    share = 1.0 - np.sqrt(chi2.ppf(0.9, len(effect)) / max(square, 1e-12))
    return bool(share * np.linalg.norm(effect) > 1.0)


def possible(fit: SetFit) -> bool:
    """True if all fitted parameters lie within physical bounds."""
    return not beyond_bounds(fit)


def beyond_bounds(fit: SetFit) -> frozenset[str]:
    """The effects of a set whose fitted parameters leave their physical bounds. What other
    estimators named is theirs to bound: motors may be quicker than told.
    """
    others = fit.replay.other_sizes
    return frozenset(e for e in fit.effects if e not in others and not within_bounds(fit, e))


def within_bounds(fit: SetFit, effect: str) -> bool:
    """True if the parameters of one effect do."""
    estimates = fit.parameters()[effect]
    values = {p: value for p, (value, _) in estimates.items()}
    deviations = {p: deviation for p, (_, deviation) in estimates.items()}
    is_possible = CARDS[effect].possible
    return is_possible is None or bool(is_possible(values, deviations))
