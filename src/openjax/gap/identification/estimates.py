"""An identification in the diagnosis' words: values of effects with their
covariance.
"""

from dataclasses import dataclass

import numpy as np

from openjax.gap.identification.search import TorqueFit


@dataclass(frozen=True, eq=False)
class EffectEstimates:
    """`value` (n,) and `covariance` (n, n) of effects' parameters `names`: (effect,
    parameter). `clock`: s by which motors answer later than logged, and its standard
    deviation; a delay in the vehicle and clocks that are off look alike.
    `without_rows` (n, n): the covariance without what rows hide.
    """

    names: tuple[tuple[str, str], ...]
    value: np.ndarray
    covariance: np.ndarray
    clock: tuple[float, float]
    fit: TorqueFit
    without_rows: np.ndarray

    def of(self, effect: str, parameter: str) -> tuple[float, float]:
        """Value and standard deviation of one parameter."""
        place = self.names.index((effect, parameter))
        return float(self.value[place]), float(np.sqrt(self.covariance[place, place]))


ESTIMATED = (
    ("motor_lag", "extra_up"),
    ("motor_lag", "extra_down"),
    ("inertia", "xx"),
    ("inertia", "yy"),
    ("yaw_torque", "ratio"),
)
"""Yaw tells the ratio of torque to the inertia about z, so that inertia is taken as it
stands.
"""
TORQUES = tuple(dict.fromkeys(effect for effect, _ in ESTIMATED))
GAINS = TORQUES[1:]  # which a replay of the motion doesn't tell: it gives up feedback


def of_fit(fit: TorqueFit, vehicle) -> EffectEstimates:
    """Estimates, by a fit of the torques, of motor lag, inertia and yaw torque, with nothing
    taken for granted of the loop around them.

    A slow motor and a large inertia both weaken the response, and only the lag turns
    its phase: the covariance says how well these flights tell them apart.
    """
    up = float(vehicle.motor_time_constant)
    down = up * float(vehicle.motor_slowdown_ratio)
    roll, pitch, yaw = fit.value[3:6]
    value = np.array([fit.value[0] - up, fit.value[1] - down, 1 / roll, 1 / pitch, yaw])
    slopes = np.zeros((5, len(fit.value)))
    slopes[0, 0] = slopes[1, 1] = slopes[4, 5] = 1.0
    slopes[2, 3] = -1.0 / roll**2
    slopes[3, 4] = -1.0 / pitch**2
    covariance = slopes @ fit.covariance @ slopes.T
    without_rows = slopes @ (fit.covariance - np.diag(fit.row_errors**2)) @ slopes.T
    clock = float(fit.value[2]), float(np.sqrt(fit.covariance[2, 2]))
    return EffectEstimates(ESTIMATED, value, covariance, clock, fit, without_rows)
