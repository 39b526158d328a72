"""How well a set of effects agrees with the identified response of the torques.

The replay of the motion gives up what feedback does within a block, and with it most of
what a lag shows. The identification keeps it. So its estimates count as a measurement
of lag, inertia and yaw torque beside the replay's, as exact as their intervals and what
such vehicles usually differ by.
"""

from collections.abc import Collection, Mapping

import numpy as np

from openjax.gap.identification.estimates import EffectEstimates
from openjax.gap.model.library import PLACE

USUAL = {"motor_lag": 0.007, "inertia": 0.25, "yaw_torque": 0.3}
"""s, and as logarithms: what other effects (a used battery, limits of the motors, the
floor) do to lags and gains, and what vehicles that nobody would call faulty differ by.
"""
UNKNOWN_MAP = 0.5
"""The same of gains where motor commands are duty cycles: the map's slope isn't
known.
"""
LEAST = 0.05  # of a gain
HOVER = 0.62  # of the largest thrust, where the slope of a thrust curve is taken
FARTHEST = 40.0  # nats: no response says more, as forms are never quite the model's


def support(estimates: EffectEstimates, theta: np.ndarray, pwm: bool, acts: bool = False) -> float:
    """Log density, up to a constant and at most FARTHEST below the best, of the
    estimates for parameters theta (P,) of the replay. Where it is known that something
    `acts`, gains are taken as they were measured.
    """
    usual = np.array([USUAL[e] for e, _ in estimates.names])
    gains = np.array([e != "motor_lag" for e, _ in estimates.names])
    if acts:
        usual = np.where(gains, 0.0, usual)
    if pwm:
        usual = np.where(gains, np.hypot(usual, UNKNOWN_MAP), usual)
    return -min(distance(estimates, theta, usual), FARTHEST)


def distance(
    estimates: EffectEstimates, theta: np.ndarray, spread: np.ndarray | float = 0.0
) -> float:
    """Nats by which estimates are off from parameters theta (P,), where vehicles differ
    by `spread` (n,): s of lags, logarithms of gains.
    """
    gains = np.array([e != "motor_lag" for e, _ in estimates.names])
    prediction = predict(estimates, theta)
    off = estimates.value - prediction
    off[gains] = np.log(estimates.value[gains] / np.maximum(prediction[gains], LEAST))
    scale = np.where(gains, estimates.value, 1.0)
    covariance = estimates.covariance / np.outer(scale, scale)
    covariance += np.square(spread) * np.eye(len(off))
    return 0.5 * float(off @ np.linalg.solve(covariance, off))


def predict(estimates: EffectEstimates, theta: np.ndarray) -> np.ndarray:
    """What the estimates would be: a weaker thrust turns the vehicle as a larger
    inertia does.
    """

    thrust = _thrust_slope(theta)
    out = np.array([theta[PLACE[key]] for key in estimates.names])
    for number, (effect, _) in enumerate(estimates.names):
        if effect == "inertia":
            out[number] /= thrust
        elif effect == "yaw_torque":
            out[number] *= thrust / theta[PLACE["inertia", "zz"]]
    return out


def told_by(
    response: Mapping[tuple[str, str], tuple[float, float]],
    theta: np.ndarray,
    effects: Collection[str],
) -> dict[tuple[str, str], tuple[float, float]]:
    """{(effect, parameter): (value, standard deviation)} of the moments of inertia and
    the yaw torque of a set of effects, by what the torques' `response` tells and the
    thrust of parameters theta (P,). Of yaw it is the ratio of torque to inertia, which
    tells neither if both may be off.
    """
    thrust = _thrust_slope(theta)
    out = {}
    for axis in ("xx", "yy"):
        if ("inertia", axis) in response:
            value, deviation = response["inertia", axis]
            out["inertia", axis] = (value * thrust, deviation * thrust)
    both = {"inertia", "yaw_torque"} <= set(effects)
    if ("yaw_torque", "ratio") in response and not both:
        value, deviation = response["yaw_torque", "ratio"]
        out["yaw_torque", "ratio"] = (value / thrust, deviation / thrust)
        inverse = thrust / value
        out["inertia", "zz"] = (inverse, inverse * deviation / value)
    return out


def _thrust_slope(theta: np.ndarray) -> float:
    """By how many times the nominal slope thrust rises where vehicles hover."""

    def of(effect, parameter):
        return float(theta[PLACE[effect, parameter]])

    slope = of("thrust_curve", "slope") + 2.0 * HOVER * of("thrust_curve", "curvature")
    return max(slope * (1.0 + of("thrust_scale", "scale")), 0.1)
