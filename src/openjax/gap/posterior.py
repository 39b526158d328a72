"""Causes that explain what was measured: a linear model with normal errors, weighed
exactly for every small set of causes.

Quantities differ from what is assumed by q = A theta + e, with sizes theta ~ N(0, P) of
the causes of a set and errors e ~ N(0, C). A set's evidence is the density of q under
N(0, C + A P A'), which charges a cause for the sizes that it could have had; the sizes,
given q, are normal as well (Rasmussen, Williams, Gaussian Processes for Machine
Learning, appendix A).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

LARGEST = 3  # causes of a set


@dataclass(frozen=True, eq=False)
class Estimate:
    """By how much the quantities `names` (n,) differ from the assumed ones."""

    names: tuple[str, ...]
    value: Float[np.ndarray, " quantities"]
    covariance: Float[np.ndarray, "quantities quantities"]

    def with_doubts(self, directions: Float[np.ndarray, "quantities doubts"], sizes) -> "Estimate":
        """The estimate where each direction (n, k) may be off by its size (k,) as well."""
        columns = np.asarray(directions) * np.asarray(sizes)
        return replace(self, covariance=self.covariance + columns @ columns.T)


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause: its effect on quantities, and its usual size."""

    name: str
    loads: Float[np.ndarray, "quantities sizes"]
    spread: Float[np.ndarray, "sizes sizes"]
    log_odds: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """A set of causes with its `weight` among all sets; `sizes` {cause: mean and
    covariance}.
    """

    weight: float
    sizes: dict[str, tuple[np.ndarray, np.ndarray]]


def explain(estimate: Estimate, causes: Sequence[Cause]) -> list[Explanation]:
    """All sets of at most `LARGEST` of the causes, the likeliest first."""
    sets = [s for n in range(LARGEST + 1) for s in combinations(causes, n)]
    explanations = [_explanation(estimate, members) for members in sets]
    nats = np.array([density for density, _ in explanations])
    weights = np.exp(nats - nats.max())
    weights /= weights.sum()
    order = np.argsort(-weights)
    return [Explanation(float(weights[k]), explanations[k][1]) for k in order]


def _explanation(estimate: Estimate, members: Sequence[Cause]):
    """Log of prior odds times evidence of a set, and the sizes of its causes."""
    covariance = estimate.covariance.copy()
    for cause in members:
        covariance += cause.loads @ cause.spread @ cause.loads.T
    scores = np.linalg.solve(covariance, estimate.value)
    nats = -0.5 * estimate.value @ scores - 0.5 * np.linalg.slogdet(covariance)[1]
    sizes = {}
    for cause in members:
        gain = cause.spread @ cause.loads.T
        reduction = gain @ np.linalg.solve(covariance, gain.T)
        sizes[cause.name] = (gain @ scores, cause.spread - reduction)
    return float(nats) + sum(cause.log_odds for cause in members), sizes
