"""Causes weighed against each other and against no change, by how well each, with the
spread of a day, predicts the difference of all figures: one Bayesian model selection.
"""

from dataclasses import dataclass

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.trims.causes import CAUSES, SIDES, Hypotheses, trims_with
from openjax.gap.trims.change import Interval


@dataclass(frozen=True)
class Weighed:
    """`probability` that something changed; the rest holds if so: `posterior`
    (N,) of the hypotheses.
    """

    probability: float
    causes: dict[str, float]
    places: dict[tuple[int, ...], float]
    posterior: np.ndarray
    hypotheses: Hypotheses

    def place(self) -> tuple[tuple[int, ...], list[tuple[int, ...]]]:
        """The smallest place that holds more than half of the probability, and the
        places within it: a rotor, two rotors, a side (one or both of its rotors), else
        what is most probable.
        """
        best = max(self.places, key=lambda p: self.places[p])
        if self.places[best] > DECISION.least_probability:
            return best, [best]
        sides = {
            side: [side, side[:1], side[1:]] for side, name in SIDES.items() if name != "diagonal"
        }
        shares = {side: sum(self.places[p] for p in within) for side, within in sides.items()}
        side = max(shares, key=lambda p: shares[p])
        if shares[side] > DECISION.least_probability:
            return side, sides[side]
        return best, [best]

    def _within(self, places: list[tuple[int, ...]]) -> np.ndarray:
        return np.isin(self.hypotheses.place, [self.hypotheses.places.index(p) for p in places])

    def causes_at(self, places: list[tuple[int, ...]]) -> dict[str, float]:
        """Probability of each cause at some places."""
        inside = self._within(places)
        each = np.bincount(self.hypotheses.cause[inside], self.posterior[inside], len(CAUSES))
        return dict(zip(CAUSES, (each / each.sum()).tolist(), strict=True))

    def size(self, places: list[tuple[int, ...]]) -> Interval:
        """Median and 90 % interval of the size at some places."""
        inside = self._within(places)
        order = np.argsort(self.hypotheses.size[inside])
        share = np.cumsum(self.posterior[inside][order])
        values = self.hypotheses.size[inside][order]
        low, middle, high = (
            float(values[np.searchsorted(share, q * share[-1])]) for q in (0.05, 0.5, 0.95)
        )
        return Interval(middle, low, high)


def weigh(
    hypotheses: Hypotheses, difference: np.ndarray, scale: np.ndarray, freedom: np.ndarray
) -> Weighed:
    """Posterior of every cause, place and size: Student's distribution around the
    change that each predicts.

    difference, scale and freedom (F,) of the figures; what the logs don't give is NaN
    and tells nothing.
    """
    is_given = np.isfinite(difference)
    scale = scale[is_given]
    freedom = freedom[is_given]

    def log_density(rest: np.ndarray) -> np.ndarray:
        far = np.log1p((rest[..., is_given] / scale) ** 2 / freedom)
        return np.asarray(-0.5 * ((freedom + 1.0) * far).sum(-1))

    none = log_density(difference)
    # what would show only in figures that these logs lack can't be weighed
    shows = (hypotheses.change[:, is_given] != 0).any(1)
    each = np.where(shows, np.log(hypotheses.weight), -np.inf) + log_density(
        difference - hypotheses.change
    )
    top = max(each.max(), none)
    posterior = DECISION.change_prior * np.exp(each - top)
    total = posterior.sum() + (1.0 - DECISION.change_prior) * np.exp(none - top)
    probability = float(posterior.sum() / total)
    posterior /= posterior.sum()
    causes = {c: float(posterior[hypotheses.cause == k].sum()) for k, c in enumerate(CAUSES)}
    places = {
        p: float(posterior[hypotheses.place == k].sum()) for k, p in enumerate(hypotheses.places)
    }
    return Weighed(probability, causes, places, posterior, hypotheses)


def least_shown(
    hypotheses: Hypotheses,
    mixer: np.ndarray,
    trims: np.ndarray,
    scale: np.ndarray,
    freedom: np.ndarray,
) -> float:
    """The loss of a single rotor that would just be said to be a change, whichever
    rotor it is, by its trims alone.
    """
    worst = 0.0
    for rotor in range(4):
        low = 0.0
        high = 1.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            change = np.full(len(scale), np.nan)
            change[: len(trims)] = trims_with(mixer, trims, 1.0 + middle * (np.arange(4) == rotor))
            chance = weigh(hypotheses, change, scale, freedom).probability
            is_shown = chance > DECISION.least_probability
            low, high = (low, middle) if is_shown else (middle, high)
        worst = max(worst, high / (1.0 + high))
    return worst
