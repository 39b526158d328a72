"""The search for the parameters of torques: Gauss and Newton's steps from several
lags.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from openjax.flights.track import Track
from openjax.gap.identification.prediction_errors import LOGARITHMS, TINY, Problem, value_at
from openjax.gap.identification.row_errors import hidden_errors, turning

SEARCHED = np.array([[0.002, 0.15], [0.02, 5.0]])
"""Time constants, s, and gains beyond which nothing is looked for."""
# s, a cycle of the rate loop: when within it motors answer is convention
EARLIEST = -0.002
ITERATIONS = 25
LARGEST_STEP = np.array([0.8, 0.8, 0.01, 1.2, 1.2, 1.2, 8.0, 8.0, 0.003])
"""Of the search, in one step: logarithms, s, 1/s, share."""
LEAST_STEP = 0.003  # of that, at which a step that gains nothing isn't halved further
SMALL = 0.05  # nats that end the search
BLOCK = 1.0  # s over which errors may hang together
LAGS = (0.025, 0.07)  # s, starts of the lags
SWEEPS = 2


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """`value` (9,) and `covariance` (9, 9) of `NAMES`; `loss` nats; `noise` {axis:
    coefficients (p,)}; `whole` innovations' variances (3,); `turning` (3,): what each
    axis turns, in standard deviations of its noise; `row_errors` (9,): standard
    deviations of what rows hide, a part of the covariance.
    """

    value: np.ndarray
    covariance: np.ndarray
    loss: float
    noise: list
    whole: np.ndarray
    turning: np.ndarray
    row_errors: np.ndarray

    @property
    def clock(self) -> float:
        """s by which motors act later than logged."""
        return float(self.value[2])

    def with_gain_error(self, error: float) -> TorqueFit:
        """The fit where nothing tells the gyroscope's gain, which is known to this
        standard deviation alone. It is a part of every torque's gain; a reference of the
        same vehicle has it too, as it has what rows hide.
        """
        errors = np.zeros(len(self.value))
        errors[3:6] = error * self.value[3:6]
        return replace(
            self,
            covariance=self.covariance + np.diag(errors**2),
            row_errors=np.hypot(self.row_errors, errors),
        )


def begin(problem: Problem, late: float) -> np.ndarray:
    """A place (9,) to search from, with motors `late` s: of some lags that of the least
    loss, once gains, in which the model is linear, are fitted to it.
    """
    candidates = []
    for lag in LAGS:
        place = problem.start.copy()
        place[:3] = np.log(lag), np.log(lag), late
        for _ in range(SWEEPS):
            place = _fit_gains(problem, place)
        candidates.append((problem.solve(place)[0], place))
    return min(candidates, key=lambda b: b[0])[1]


def _fit_gains(problem: Problem, place: np.ndarray) -> np.ndarray:
    """The place with gains as of least squares, for the noise as it is."""
    gains = np.exp(place[3:6])
    _, axes = problem.solve(place)
    hessian = problem.precision[3:6, 3:6] / gains**2
    push = np.zeros(3)
    for errors, slopes, _ in axes:
        linear = slopes[:, 3:6] / gains
        hessian += linear.T @ linear / (errors.var() + TINY)
        push += linear.T @ errors / (errors.var() + TINY)
    solution = gains - np.linalg.solve(hessian, push)
    out = place.copy()
    out[3:6] = np.log(np.maximum(solution, SEARCHED[1][0]))
    return _clip(problem, out)


def search(problem: Problem, place: np.ndarray) -> TorqueFit:
    """Gauss-Newton from a place (9,), in steps no larger than its linearisation is good
    for.
    """
    value = place
    loss, axes = problem.solve(value)
    for _ in range(ITERATIONS):
        step = _step(problem, value, axes)
        while True:
            ahead = _clip(problem, value + step)
            loss_ahead, axes_ahead = problem.solve(ahead)
            if loss_ahead < loss or np.abs(step / LARGEST_STEP).max() < LEAST_STEP:
                break
            step = 0.3 * step
        gain = loss - loss_ahead
        if gain <= 0.0:
            break
        value, loss, axes = ahead, loss_ahead, axes_ahead
        if gain < SMALL:
            break
    scale = np.ones(len(value))
    scale[LOGARITHMS] = value_at(value)[LOGARITHMS]
    row_errors = hidden_errors(problem, axes)
    return TorqueFit(
        value_at(value),
        (_covariance(problem, value, axes) + np.diag(row_errors**2)) * np.outer(scale, scale),
        loss,
        [a[2] for a in axes],
        np.array([a[0].var() for a in axes]),
        turning(problem, axes)[0],
        row_errors * scale,
    )


def _step(problem: Problem, value: np.ndarray, axes: list) -> np.ndarray:
    """Gauss-Newton's step (9,), of at most LARGEST_STEP; what stands at a bound and is
    pushed beyond stays.
    """
    hessian, push = _normal(problem, value, axes)
    probe = _clip(problem, value - 1e-6 * np.sign(push))
    free = np.flatnonzero(probe != value)
    step = np.zeros(len(value))
    step[free] = np.linalg.solve(hessian[np.ix_(free, free)], -push[free])
    return step / max(np.abs(step / LARGEST_STEP).max(), 1.0)


def earliest(record: Track) -> float:
    """The delay (s) below which nothing is looked for: motors act after their command."""
    return EARLIEST if record.hides_ticks else 0.0


def _clip(problem: Problem, value: np.ndarray) -> np.ndarray:
    out = value.copy()
    out[:2] = np.clip(out[:2], *np.log(SEARCHED[0]))
    out[2] = max(out[2], earliest(problem.records[0]))
    out[3:6] = np.clip(out[3:6], *np.log(SEARCHED[1]))
    return out


def _normal(problem: Problem, value, axes):
    hessian = problem.precision.copy()
    push = problem.precision @ (value - problem.start)
    for errors, slopes, _ in axes:
        hessian += slopes.T @ slopes / (errors.var() + TINY)
        push += slopes.T @ errors / (errors.var() + TINY)
    return hessian, push


def _covariance(problem: Problem, value, axes) -> np.ndarray:
    """Of the parameters, widened where errors hang together over seconds (a
    sandwich's).
    """
    hessian, _ = _normal(problem, value, axes)
    inverse = np.linalg.inv(hessian)
    scores = np.zeros_like(hessian)
    for errors, slopes, _ in axes:
        pieces = np.arange(0, len(errors), max(int(BLOCK / problem.dt), 1))
        sums = np.add.reduceat(slopes * errors[:, None], pieces, 0) / (errors.var() + TINY)
        scores += sums.T @ sums
    wider = np.trace(scores @ inverse) / len(hessian)
    return inverse * max(1.0, wider)
