"""Set-points: what a vehicle is asked for, and what of it fits into the packet that
`cflib` sends.
"""

import math
from typing import NamedTuple

OFF = 0
"""Mode of a set-point: motors off."""
RATES = 1
"""Roll and pitch are body rates."""
ANGLES = 2
"""Roll and pitch are angles."""

_LEAST = 10001
"""Thrust counts of 0 % in `send_setpoint_manual`."""
_MOST = 60000
"""Those of 100 %."""
_COUNTS = 65536
"""Motor counts of full thrust."""
LEAST_THRUST = _LEAST / _COUNTS
"""No set-point but "off" asks for less."""
MOST_THRUST = _MOST / _COUNTS
"""None asks for more."""


class SetPoint(NamedTuple):
    """Roll, pitch (rad or, by `mode`, rad/s; body frame, pitch positive nose down), yaw
    rate (rad/s), thrust 0..1 of the four rotors' maximum.
    """

    mode: int = OFF
    roll: float = 0.0
    pitch: float = 0.0
    yaw_rate: float = 0.0
    thrust: float = 0.0


MOTORS_OFF = SetPoint()


def manual_arguments(set_point: SetPoint) -> tuple[float, float, float, float, bool]:
    """Arguments of `cflib`'s `send_setpoint_manual` for a set-point that isn't off:
    degrees, thrust in percent.

    `cflib` turns pitch around for the firmware, whose pitch points the other way, so
    here it's openjax's.
    """
    percent = 100.0 * (set_point.thrust * _COUNTS - _LEAST) / (_MOST - _LEAST)
    return (
        math.degrees(set_point.roll),
        math.degrees(set_point.pitch),
        math.degrees(set_point.yaw_rate),
        min(max(percent, 0.0), 100.0),
        set_point.mode == RATES,
    )


def as_sent(set_point: SetPoint) -> SetPoint:
    """The set-point with the thrust that is left of it in a packet: that is what a log
    should hold.
    """
    return set_point._replace(thrust=min(max(set_point.thrust, LEAST_THRUST), MOST_THRUST))


def from_action(action, thrust_limit: float) -> SetPoint:
    """The set-point of a policy's action (4,) in -1..1: thrust, roll, pitch and yaw rate up to pi
    rad/s.

    The same numbers as `openjax.pursuit.environment.action_to_command`, without a trip to JAX. What
    is infinite isn't cut to full thrust, but NaN, as whoever sends set-points refuses.
    """
    thrust, roll, pitch, yaw = (
        min(max(float(x), -1.0), 1.0) if math.isfinite(x) else math.nan for x in action
    )
    return SetPoint(
        mode=RATES,
        roll=math.pi * roll,
        pitch=math.pi * pitch,
        yaw_rate=math.pi * yaw,
        thrust=min(0.5 * (thrust + 1.0), thrust_limit),
    )
