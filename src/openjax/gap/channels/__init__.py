"""What a log says by ways of its own: pose, radio, rate loop and motion, each a channel with the same few methods."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student


@dataclass(frozen=True)
class Estimated:
    """A parameter's value and its standard deviations below and above."""

    value: float
    below: float
    above: float


class Channel(Protocol):
    """One way by which a log tells effects. `path` is the `Card.path` of those that it reads."""

    path: str = ""

    def acting(self) -> dict[str, float]:
        """{effect: probability} of the channel's effects that the log shows."""

    def undetectable(self) -> list[str]:
        """The channel's effects that these flights would not show at their usual size."""
        return []

    def estimate(self, effect: str, parameter: str) -> Estimated:
        """A parameter of an acting effect."""

    def residuals(self, named) -> dict[str, list[np.ndarray]]:
        """{name: [(T,) per track]} of normalised prediction errors with the effects `named`."""


def few(count: int) -> float:
    """By what an error from so many flights is widened: Student's quantile of a 90 % interval over the normal one."""
    return float(student.ppf(0.95, max(count - 1, 1)) / norm.ppf(0.95))


def robust_deviation(covariance: np.ndarray, pushes: np.ndarray) -> np.ndarray:
    """Standard deviations (p,) of parameters: those of `covariance` (p, p), or what flights differ by where that is more: the
    sandwich of their gradients `pushes` (F, p), widened where they are few (Liang, Zeger 1986)."""
    model, count = np.sqrt(np.diag(covariance)), len(pushes)
    if count < 2 or not len(model):
        return model
    apart = pushes - pushes.mean(0)
    between = covariance @ apart.T @ apart @ covariance * count / (count - 1)
    return np.maximum(few(count) * np.sqrt(np.maximum(np.diag(between), 0.0)), model)
