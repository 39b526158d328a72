"""What the simulator that trains should take from an identification."""

import numpy as np

from openjax.gap.identification.quantities import REACH, Identification
from openjax.vehicle.effects import EFFECTS

CLEAR = 3.0  # standard deviations from the simulator's value
MATTERS = {"motor_lag": 0.006, "inertia": 0.15, "yaw_torque": 0.2}
"""s, and shares: differences from which training should know."""


def corrections(identification: Identification, effects) -> tuple[dict, dict]:
    """Values and 90 % intervals {effect: {parameter: ...}} of motor lag, inertia and
    yaw torque as identified: of those `effects`, which were named, and of others that
    differ clearly and by as much as matters. Of duty cycles only the lag: gains hold
    their map's slope.
    """
    if not identification.trustworthy:
        return {}, {}
    values: dict = {}
    intervals: dict = {}
    estimates = identification.estimates
    deviation = np.sqrt(np.diag(estimates.covariance))
    for effect in dict.fromkeys(e for e, _ in estimates.names):
        if identification.duty_cycles and effect != "motor_lag":
            continue
        places = [i for i, (e, _) in enumerate(estimates.names) if e == effect]
        none = 0.0 if effect == "motor_lag" else 1.0
        off = np.abs(estimates.value[places] - none)
        clear = (off > CLEAR * deviation[places]) & (off > MATTERS[effect])
        if effect not in effects and not clear.any():
            continue
        for i in places:
            parameter = estimates.names[i][1]
            value = float(estimates.value[i])
            reach = REACH * float(deviation[i])
            low = (
                value - reach
                if effect == "motor_lag"
                else value * np.exp(-reach / value)
            )
            high = (
                value + reach
                if effect == "motor_lag"
                else value * np.exp(reach / value)
            )
            least, most = EFFECTS[effect].parameters[parameter].limits()
            ends = (float(np.clip(end, least, most)) for end in (value, low, high))
            values.setdefault(effect, {})[parameter] = next(ends)
            intervals.setdefault(effect, {})[parameter] = tuple(ends)
    return values, intervals
