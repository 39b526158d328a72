"""How the torques of a case answer beside those of the same vehicle's reference flights.

What rows hide, and what a gyroscope's filter or a loop's noise makes of a response, is
the same in both, so a change shows where the response itself can't be told.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from openjax.gap.identification.estimates import EffectEstimates
from openjax.gap.identification.quantities import Identification
from openjax.gap.identification.row_errors import LARGEST_ERROR, NOISE_IN_GAIN
from openjax.gap.identification.support import predict

LAG = 0.0015  # s
GAIN = 0.04  # as a logarithm
"""What two sets of flights of one vehicle differ by in which nothing acts on torques,
beyond their errors: with these medians of 33 cases of seed 2302 over .67 are 1.6 ms,
and .03 to .05.
"""
RIDGE = 0.005  # s
GAIN_OF_LAG = -35.0  # 1/s, of an inertia as a logarithm
"""A larger lag with a smaller inertia answers nearly the same: in six of these 52
cases both moved so, by 12 to 26 ms.
"""
FARTHEST = 11.0
"""Nats: one case in ten lies several times as far off in each of five numbers, and that
density is lower by as much (a mixture of normal distributions).
"""


def comparable(here: Identification | None, there: Identification | None) -> bool:
    """Whether the responses of two sets of flights have the same errors of their rows,
    or none that matter.
    """
    if here is None or there is None or here.sampled != there.sampled:
        return False
    return all(found.trustworthy or found.sampled for found in (here, there))


def change_of(
    here: EffectEstimates, there: EffectEstimates, theta: np.ndarray
) -> EffectEstimates:
    """The estimates of a case as if those of its reference had told the parameters
    theta (P,), which are the vehicle's while nothing acts.
    """
    gains = np.array([e != "motor_lag" for e, _ in here.names])
    before = predict(there, theta)
    value = before + here.value - there.value
    value[gains] = before[gains] * here.value[gains] / there.value[gains]
    slopes = {"motor_lag": 1.0, "inertia": GAIN_OF_LAG}
    ridge = RIDGE * np.array([slopes.get(e, 0.0) for e, _ in here.names])
    spread = np.square(np.where(gains, GAIN, LAG))
    covariance = np.outer(ridge, ridge) + np.diag(spread + _of_noise(here, there))
    for found in (here, there):
        scale = np.where(gains, found.value, 1.0)
        covariance = covariance + found.shown / np.outer(scale, scale)
    scale = np.where(gains, value, 1.0)
    covariance = covariance * np.outer(scale, scale)
    return EffectEstimates(
        here.names, value, covariance, here.clock, here.fit, covariance
    )


def given(
    estimates: EffectEstimates, theta: np.ndarray, free: Collection[tuple[str, str]]
) -> EffectEstimates:
    """The estimates of those parameters that are `free` if all others are as in theta
    (P,): a lag alone is told more sharply than one beside an inertia.
    """
    own = [k for k, name in enumerate(estimates.names) if name in free]
    rest = [k for k, name in enumerate(estimates.names) if name not in free]
    covariance = estimates.covariance
    off = estimates.value - predict(estimates, theta)
    across = covariance[np.ix_(own, rest)]
    gain = np.linalg.solve(covariance[np.ix_(rest, rest)], across.T).T
    return replace(
        estimates,
        names=tuple(estimates.names[k] for k in own),
        value=estimates.value[own] - gain @ off[rest],
        covariance=covariance[np.ix_(own, own)] - gain @ across.T,
    )


def _of_noise(here: EffectEstimates, there: EffectEstimates) -> np.ndarray:
    """(n,) variances of what a loop that answers noise makes of gains, as logarithms,
    where one set of flights turns less than the other.
    """
    weaker = [
        np.minimum(NOISE_IN_GAIN / found.fit.turning**2, LARGEST_ERROR)
        for found in (here, there)
    ]
    apart = dict(zip(("xx", "yy", "ratio"), (weaker[0] - weaker[1]) ** 2, strict=True))
    return np.array([apart.get(parameter, 0.0) for _, parameter in here.names])
