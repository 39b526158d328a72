"""The torques of a case beside those of the same vehicle's reference flights.

What rows hide, and what a gyroscope's filter or a loop's noise makes of a response, is
the same in both, so a change shows where the response itself can't be told.
"""

from dataclasses import replace

import numpy as np

from openjax.gap.identification.estimates import EffectEstimates
from openjax.gap.identification.quantities import Identification
from openjax.gap.identification.row_errors import LARGEST_ERROR, NOISE_IN_GAIN

LAG = 0.0015  # s
GAIN = 0.04  # as a logarithm
"""What two sets of flights of one vehicle differ by in which nothing acts on torques,
beyond their errors: with these medians of 33 cases of seed 2302 over .67 are 1.6 ms,
and .03 to .05.
"""
RIDGE = 0.005  # s
GAIN_OF_LAG = -35.0  # 1/s, of an inertia as a logarithm
"""A larger lag with a smaller inertia answers nearly the same: in six of 52 cases of
that seed both moved so, by 12 to 26 ms.
"""
ALONG_RIDGE = {
    **dict.fromkeys(("extra_up", "extra_down"), 1.0),
    **dict.fromkeys(("xx", "yy"), GAIN_OF_LAG),
    "ratio": -GAIN_OF_LAG,
}
"""{parameter: how it moves with a lag}."""
LAGS = ("extra_up", "extra_down")


def comparable(case: Identification | None, reference: Identification | None) -> bool:
    """True if the responses of two sets of flights have the same errors of their rows,
    or none that matter.
    """
    if case is None or reference is None:
        return False
    if case.single_samples != reference.single_samples:
        return False
    return all(i.trustworthy or i.single_samples for i in (case, reference))


def change_of(
    case: EffectEstimates, reference: EffectEstimates, start: np.ndarray
) -> EffectEstimates:
    """The estimates of a case as if those of its reference had told the values `start`
    (5,), which are the vehicle's while nothing acts.
    """
    gains = np.array([p not in LAGS for _, p in case.names])
    value = start + case.value - reference.value
    value[gains] = start[gains] * case.value[gains] / reference.value[gains]
    ridge = RIDGE * np.array([ALONG_RIDGE.get(p, 0.0) for _, p in case.names])
    spread = np.square(np.where(gains, GAIN, LAG))
    covariance = np.outer(ridge, ridge) + np.diag(spread + _of_noise(case, reference))
    for estimates in (case, reference):
        scale = np.where(gains, estimates.value, 1.0)
        covariance = covariance + estimates.without_rows / np.outer(scale, scale)
    scale = np.where(gains, value, 1.0)
    covariance = covariance * np.outer(scale, scale)
    delays, errors = zip(case.clock, reference.clock, strict=True)
    clock = float(delays[0] - delays[1]), float(np.hypot(*errors))
    return replace(case, value=value, covariance=covariance, without_rows=covariance, clock=clock)


def _of_noise(case: EffectEstimates, reference: EffectEstimates) -> np.ndarray:
    """(n,) variances of what a loop that answers noise makes of gains, as logarithms,
    where one set of flights turns less than the other.
    """
    weaker = [
        np.minimum(NOISE_IN_GAIN / e.fit.turning**2, LARGEST_ERROR) for e in (case, reference)
    ]
    squares = np.square(weaker[0] - weaker[1])
    of_parameter = dict(zip(("xx", "yy", "ratio"), squares, strict=True))
    return np.array([of_parameter.get(p, 0.0) for _, p in case.names])
