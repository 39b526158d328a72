"""Errors of the parameters by what rows hide of a rate loop that runs several times within
them.
"""

import numpy as np

from openjax.gap.identification.prediction_errors import NAMES, TINY, Problem

# s of the rate loop: when within one motors get their command is convention
HALF_CYCLE = 0.001
NOISE_IN_GAIN = 35.0
NOISE_IN_LAG = 2.2
QUICK = 0.03  # s
"""What rows of means hide of a rate loop that answers noise weakens the response that
they show. Errors of gains, as logarithms, are so much over the square of what an axis
turns in standard deviations of its noise; errors of lags over that of what it turns
within QUICK, beyond noise.
"""
LARGEST_ERROR = 2.0  # as a logarithm: nothing is known
LEAST_LAG = 0.03
LEAST_GAIN = 0.01
LEAST_DAMPING = 0.2
"""Errors of lags and gains, as logarithms, and of damping, 1/s, that rows leave in still
air: by what they hide, and by stamps that are right to half a cycle.
"""
SAMPLED_LAG = 0.3
SAMPLED_GAIN = 0.45
SAMPLED_DAMPING = 0.5  # 1/s
"""The same of single samples, which miss most of what the loop does. Root mean squares
of simulated flights in calm and gusty air, `experiments/results/identification.json`.
"""


def turning(problem: Problem, axes: list) -> tuple[np.ndarray, np.ndarray]:
    """Turning of each axis (3,), and its turning within QUICK, in standard deviations
    of its noise.
    """
    noise = np.array([e.var() for e, _, _ in axes]) + TINY
    rows = max(round(QUICK / problem.dt), 1)
    whole = np.concatenate([r.body_rates for r in problem.records])
    quick = np.concatenate([r.body_rates[rows:] - r.body_rates[:-rows] for r in problem.records])
    return np.sqrt(whole.var(0) / noise), np.sqrt(0.5 * quick.var(0) / noise)


def hidden_errors(problem: Problem, axes: list) -> np.ndarray:
    """Standard deviations (9,) at a place of the search, of what rows hide."""
    out = np.zeros(len(NAMES))
    out[2] = HALF_CYCLE
    out[[0, 1]] = LEAST_LAG
    out[[3, 4, 5]] = LEAST_GAIN
    out[[6, 7]] = LEAST_DAMPING
    if not problem.records[0].hides_ticks:
        return out
    if any(r.samples for r in problem.records):
        out[[0, 1]] = SAMPLED_LAG
        out[[3, 4, 5]] = SAMPLED_GAIN
        out[[6, 7]] = SAMPLED_DAMPING
        return out
    turns, quick = turning(problem, axes)
    beyond = max(quick[:2].max() ** 2 - 1.0, NOISE_IN_LAG / LARGEST_ERROR)
    out[[0, 1]] = np.hypot(LEAST_LAG, NOISE_IN_LAG / beyond)
    gain = np.minimum(NOISE_IN_GAIN / turns**2, LARGEST_ERROR)
    out[[3, 4, 5]] = np.hypot(LEAST_GAIN, gain)
    return out
