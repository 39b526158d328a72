"""Corrections that the simulator that trains should take from an identification."""

from dataclasses import dataclass

import numpy as np

from openjax.gap.identification.quantities import REACH, Identification
from openjax.gap.model.library import CARDS
from openjax.vehicle.effects import EFFECTS

LAGS = {"extra_up": "spin_up", "extra_down": "spin_down"}
"""The time constant that an effect's parameter counts from the simulator's."""
LEAST = 0.04  # of the simulator's number, where an estimate isn't positive


@dataclass(frozen=True)
class _Number:
    """A positive number of the vehicle: a time constant (s), or a gain as a multiple."""

    effect: str
    parameter: str
    value: float
    nominal: float
    """The simulator's."""
    error: float
    """Standard deviation of the logarithm, as the report's intervals have it."""

    @property
    def ends(self) -> tuple[float, float, float]:
        """Value of the effect's parameter and the ends of its 90 % interval."""
        spread = np.exp(np.array([0.0, -REACH, REACH]) * self.error)
        parameters = self.value * spread - (self.nominal if self.parameter in LAGS else 0.0)
        least, most = EFFECTS[self.effect].parameters[self.parameter].limits()
        value, low, high = np.clip(parameters, least, most).tolist()
        return value, low, high


def corrections(identification: Identification, effects) -> tuple[dict, dict]:
    """Values and 90 % intervals {effect: {parameter: ...}} of motor lag, inertia and
    yaw torque as identified: of those `effects`, which were named, and of others that
    differ clearly and by as much as matters. Only the lag of duty cycles, whose map's
    slope the gains hold, and where an effect is named that does to gains what a larger
    inertia does.
    """
    if not identification.trustworthy:
        return {}, {}
    values: dict = {}
    intervals: dict = {}
    numbers = _numbers(identification)
    lag_alone = identification.duty_cycles or any(
        "torques" in CARDS[effect].scales for effect in effects if effect in CARDS
    )
    # yaw tells a torque over an inertia: where the inertia is named, that has all of it
    has_inertia = any(p.name == "zz" for e in effects if e in CARDS for p in CARDS[e].fitted)
    for effect in dict.fromkeys(number.effect for number in numbers):
        of_effect = [number for number in numbers if number.effect == effect]
        if lag_alone and effect != "motor_lag":
            continue
        if has_inertia and effect not in effects and CARDS[effect].torque_axes == (2,):
            continue
        departs = any(q.departs for q in identification.quantities.values() if q.effect == effect)
        if effect in effects or departs:
            values[effect] = {n.parameter: n.ends[0] for n in of_effect}
            intervals[effect] = {n.parameter: n.ends[1:] for n in of_effect}
    return values, intervals


def _numbers(identification: Identification) -> list[_Number]:
    estimates = identification.estimates
    deviations = np.sqrt(np.diag(estimates.covariance))
    out = []
    for (effect, parameter), value, deviation in zip(
        estimates.names, estimates.value, deviations, strict=True
    ):
        nominal = 1.0
        if parameter in LAGS:
            nominal = identification.quantities[LAGS[parameter]].simulator
            value += nominal
        has = max(float(value), LEAST * nominal)
        out.append(_Number(effect, parameter, has, nominal, float(deviation) / has))
    return out
