"""The independent sources of evidence in a log: pose, radio, rate loop and motion, each a channel
with the same few methods.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.stats import norm
from scipy.stats import t as student

from openjax.gap.decision import DECISION


@dataclass(frozen=True)
class Estimated:
    """A parameter's value and its standard deviations below and above."""

    value: float
    below: float
    above: float


@runtime_checkable
class Channel(Protocol):
    """One way by which a log tells effects. `path` is the `Card.path` of those that it
    reads.
    """

    path: str = ""

    def acting(self) -> dict[str, float]:
        """{effect: probability} of the channel's effects that the log shows."""

    def undetectable(self) -> list[str]:
        """The channel's effects that these flights would not show at their usual
        size.
        """
        return []

    def estimate(self, effect: str, parameter: str) -> Estimated:
        """A parameter of an acting effect."""

    def residuals(self, effects) -> dict[str, list[np.ndarray]]:
        """{name: [(T,) per track]} of normalised prediction errors with the effects
        `effects`.
        """

    def named_effects(self) -> dict[str, float]:
        """Those of the acting effects without which the channel's errors grow by more
        than an effect's form may be wrong by.
        """
        acting = self.acting()
        return {e: p for e, p in acting.items() if self.growth(e, acting) > DECISION.form_error}

    def growth(self, effect: str, acting) -> float:
        """By what share the channel's errors are larger without an effect than with all
        that act.
        """

        def squares(effects):
            residuals = self.residuals(effects).values()
            return np.array([np.mean(np.concatenate(series) ** 2) for series in residuals])

        ratio = squares(set(acting) - {effect}) / squares(acting)
        return float(np.sqrt(ratio.mean())) - 1.0


def few(count: float) -> float:
    """By what an error from so many flights is widened: Student's quantile of a 90 %
    interval over the normal one.
    """
    return float(student.ppf(0.95, max(count - 1, 1)) / norm.ppf(0.95))


def robust_deviation(
    covariance: Float[np.ndarray, "parameters parameters"],
    pushes: Float[np.ndarray, "flights parameters"],
) -> Float[np.ndarray, " parameters"]:
    """Standard deviations (p,) of parameters: those of `covariance` (p, p), or what
    flights differ by where that is more, as `between_flights` has it.
    """
    model = np.diag(covariance)
    between = np.diag(between_flights(covariance, pushes))
    return np.sqrt(np.maximum(between, model))


def of_flights(
    covariance: Float[np.ndarray, "parameters parameters"],
    pushes: Float[np.ndarray, "flights parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance (p, p) of parameters by what these flights differ by and by what
    flights usually do, as three alone say hardly how much that is (the moderated t,
    Smyth 2004); widened, so that 90 % intervals are Student's.
    """
    count = max(len(pushes), 1)
    freedom = DECISION.usual_flights + count - 1
    total = DECISION.usual_flights * DECISION.dispersion * covariance
    if count > 1:
        total = total + (count - 1) * sandwich(covariance, pushes)
    return few(freedom + 1.0) ** 2 * total / freedom


def between_flights(
    covariance: Float[np.ndarray, "parameters parameters"],
    pushes: Float[np.ndarray, "flights parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """`sandwich`, widened where flights are few; zero for a single flight."""
    if len(pushes) < 2 or not len(covariance):
        return np.zeros_like(covariance)
    return few(len(pushes)) ** 2 * sandwich(covariance, pushes)


def sandwich(
    covariance: Float[np.ndarray, "parameters parameters"],
    pushes: Float[np.ndarray, "flights parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance (p, p) of parameters by what flights differ by: that of their
    gradients `pushes` (F, p) between curvatures (Liang, Zeger 1986).
    """
    count = len(pushes)
    apart = pushes - pushes.mean(0)
    return covariance @ apart.T @ apart @ covariance * count / (count - 1)
