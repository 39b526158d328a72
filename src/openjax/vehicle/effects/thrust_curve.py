"""Thrust is not in proportion to the motor command."""

import numpy as np

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter


def motor(parameters, motor_command, context):
    """offset + slope m + curvature m^2, of which thrust is a linear function."""
    del context
    square = parameters["curvature"] * motor_command * motor_command
    return parameters["offset"] + parameters["slope"] * motor_command + square


_SOURCE = "spread of quadratic thrust maps published for the Crazyflie, as shares of the largest thrust"


_BEND = 0.02, 0.03  # of the thrust over the usual commands: least of all, and beside a change of all thrust
_STEEPNESS = 0.4, 2.2  # of the curve, where a straight line has 1: powers of the command from 0.6 to 1.9


def bends(value, deviation):
    """Whether a fitted curve bends over the usual commands, and rises as a motor's does; if not, it is another thrust or
    mass, or a force that the motors don't make."""
    del deviation
    commands = np.linspace(0.45, 0.85, 9)
    steepness = value["slope"] + 2.0 * value["curvature"] * commands
    if steepness.min() < _STEEPNESS[0] or steepness.max() > _STEEPNESS[1]:
        return False
    change = value["offset"] / commands + value["slope"] + value["curvature"] * commands - 1.0
    return bool(np.ptp(change) > np.clip(0.5 * abs(change.mean()), *_BEND))


EFFECT = Effect(
    name="thrust_curve",
    description="thrust follows offset + slope m + curvature m^2 of the motor command m",
    formula=r"m' = c_0 + c_1\,m + c_2\,m^2",
    parameters={
        "offset": Parameter("1", 0.0, (-0.05, 0.05), _SOURCE),
        "slope": Parameter("1", 1.0, (0.7, 1.3), _SOURCE),
        "curvature": Parameter("1", 0.0, (-0.3, 0.3), _SOURCE),
    },
    motor=motor,
    card=Card(
        path="physics",
        fitted=(
            Fitted("offset", mean=0.0, spread=0.08, start=0.02, step=0.001),
            Fitted("slope", mean=1.0, spread=0.2, start=0.95, step=0.001),
            Fitted("curvature", mean=0.0, spread=0.25, start=0.02, step=0.001),
        ),
        thrust_map=True,
        commoner=("thrust_scale", "mass"),
        is_itself=bends,
        sample={"curvature": 0.25},
        next_flight="steps of collective thrust between 40 and 90 %.",
    ),
)
