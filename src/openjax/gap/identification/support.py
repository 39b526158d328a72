"""How well a set of effects agrees with the identified response of the torques.

The replay of the motion gives up what feedback does within a block, and with it most of what a lag
shows; what it says of moments of inertia instead may be off by a sixth. The identification keeps
all of the motors' signal. So its estimates are further measurements of lag, inertia and yaw torque,
in the fits as in the evidence: as exact as their intervals and what such vehicles usually differ
by.

Where flights of the same vehicle with nothing wrong were identified in the same way, what counts is
the change since then. What the vehicle's form makes of the estimates is in both, and goes: a
gyroscope's gain, propellers, a motor that isn't of first order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.identification.estimates import EffectEstimates
from openjax.gap.model.library import PLACE

USUAL = {"extra_up": 0.005, "extra_down": 0.007, "xx": 0.03, "yy": 0.03, "ratio": 0.05}
"""s, and as logarithms: what vehicles that nobody would call faulty differ by from what is told of
them, each number by itself.
"""
GAIN = 0.03
"""The same of what all gains have in common: how strongly thrust follows commands."""
UNKNOWN_GAIN = 0.08
"""Of a gyroscope that no attitude is held against."""
UNKNOWN_MAP = 0.5
"""Where motor commands are duty cycles, and the map's slope isn't known."""
BETWEEN = {"extra_up": 0.0015, "extra_down": 0.002, "xx": 0.02, "yy": 0.02, "ratio": 0.04}
"""As `USUAL`, of the change between two sets of flights of one vehicle: of 56 development cases in
which no effect on the torques acts, nine in ten lie within 1.6 times these and their errors (seed
2302).
"""
EXACT = {"extra_up": 0.006, "extra_down": 0.008, "xx": 0.12, "yy": 0.12, "ratio": 0.25}
"""Standard deviations, in the same units, beyond which the replay says more than the response."""
CHARGE = 0.15
"""Of gains on another day, where the battery's charge acts unseen."""
LEAST = 0.05  # of a gain
TAIL = 20.0
"""Degrees of freedom of the errors: a search may end in the wrong place, so that ten standard
deviations are 18 nats and not 50.
"""


@dataclass(frozen=True, eq=False)
class Response:
    """What was identified of the torques: `estimates`, of whose gains `common` is what all have in
    common beyond their errors. `slope(theta)`: how strongly thrust follows the motor commands in
    those flights, of the nominal vehicle's; a weaker thrust turns the vehicle as a larger inertia
    does. `gain`: by which the gyroscope reads too much. `before`: estimates of the reference's
    flights, whose vehicle is taken for `absent` (P,).
    """

    estimates: EffectEstimates
    slope: Callable[[np.ndarray], float]
    common: float
    gain: float = 1.0
    before: EffectEstimates | None = None
    absent: np.ndarray | None = None

    @property
    def exact(self) -> bool:
        """Whether the estimates are good enough for torques to follow them."""
        limits = np.array([EXACT[p] for _, p in self.estimates.names])
        each = (self.estimates,) if self.before is None else (self.estimates, self.before)
        return all((self._deviations(e) < limits).all() for e in each)

    def _deviations(self, found: EffectEstimates) -> np.ndarray:
        """(n,) of lags, s, and logarithms of gains."""
        variances = np.diag(found.covariance if self.before is None else found.again)
        return np.sqrt(variances) / np.where(self._gains, found.value, 1.0)

    @property
    def effects(self) -> tuple[str, ...]:
        """Those that it tells."""
        return tuple(dict.fromkeys(e for e, _ in self.estimates.names))

    @property
    def _gains(self) -> np.ndarray:
        return np.array([e != "motor_lag" for e, _ in self.estimates.names])

    @cached_property
    def _root(self) -> np.ndarray:
        """(n, n) Cholesky root of the covariance of lags, s, and logarithms of gains."""
        gains = self._gains
        usual = USUAL if self.before is None else BETWEEN
        shared = np.array([_sign(e) * self.common for e, _ in self.estimates.names])
        covariance = np.outer(shared, shared)
        covariance += np.diag([usual[p] ** 2 for _, p in self.estimates.names])
        for found in (self.estimates, self.before):
            if found is not None:
                scale = np.where(gains, found.value, 1.0)
                each = found.covariance if self.before is None else found.again
                covariance += each / np.outer(scale, scale)
        return np.linalg.cholesky(covariance)

    @cached_property
    def _reference(self) -> np.ndarray:
        """(n,) by how much the reference's estimates differ from what is taken for true there."""
        if self.before is None:
            return np.zeros(len(self._gains))
        return self._off(self.before, self.absent)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """(n,) by how much the estimates differ from those that parameters theta (P,) would make, in
        standard deviations.
        """
        off = self._off(self.estimates, theta) - self._reference
        return np.linalg.solve(self._root, off)

    def answering(self, theta: np.ndarray) -> np.ndarray:
        """Parameters (P,) with lag, inertia and yaw torque such that the torques answer as they were
        identified; all else is as in theta (P,).
        """
        out = theta.copy()
        slope = max(self.gain * self.slope(theta), 0.1)
        for name, value in zip(self.estimates.names, self.estimates.value, strict=True):
            effect, _ = name
            scale = {"inertia": slope, "yaw_torque": 1.0 / slope}.get(effect, 1.0)
            out[PLACE[name]] = scale * value
        out[PLACE["inertia", "zz"]] = 1.0
        return out

    def _off(self, found: EffectEstimates, theta: np.ndarray) -> np.ndarray:
        expected = self._expected(theta)
        gains = self._gains
        off = found.value - expected
        off[gains] = np.log(found.value[gains] / np.maximum(expected[gains], LEAST))
        return off

    def _expected(self, theta: np.ndarray) -> np.ndarray:
        def of(effect, parameter):
            return float(theta[PLACE[effect, parameter]])

        slope = max(self.gain * self.slope(theta), 0.1)
        out = np.array([of(*name) for name in self.estimates.names])
        for number, (effect, _) in enumerate(self.estimates.names):
            if effect == "inertia":
                out[number] /= slope
            elif effect == "yaw_torque":
                out[number] *= slope / of("inertia", "zz")
        return out

    def measured(self, name: tuple[str, str]) -> tuple[float, float]:
        """Value and standard deviation of one number; with a reference by its change since then."""
        value, deviation = self.estimates.of(*name)
        if self.before is None:
            return value, deviation
        place = self.estimates.names.index(name)
        there = float(self.before.value[place])
        variances = self.estimates.again[place, place], self.before.again[place, place]
        then = float(self.absent[PLACE[name]])
        usual = BETWEEN[name[1]]
        if name[0] == "motor_lag":
            return then + value - there, float(np.sqrt(sum(variances) + usual**2))
        square = variances[0] / value**2 + variances[1] / there**2 + usual**2
        value = then * value / there
        return value, value * float(np.sqrt(square))


def _sign(effect: str) -> float:
    """Of what a stronger answer of all axes makes of a number."""
    return {"inertia": -1.0, "yaw_torque": 1.0}.get(effect, 0.0)


def log_density(residuals: np.ndarray) -> float:
    """Nats of residuals (n,) in standard deviations: Student's, up to a constant."""
    return -0.5 * (TAIL + len(residuals)) * float(np.log1p(residuals @ residuals / TAIL))


def weight(residuals: np.ndarray) -> float:
    """That such residuals have in a fit by least squares."""
    return (TAIL + len(residuals)) / (TAIL + float(residuals @ residuals))
