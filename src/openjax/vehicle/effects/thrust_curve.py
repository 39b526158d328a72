"""Thrust is not in proportion to the motor command."""

import numpy as np

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter


def motor(parameters, motor_command, context):
    """offset + slope m + curvature m^2 + cubic (m - MIDDLE)^3, of which thrust is a linear function."""
    del context
    square = parameters["curvature"] * motor_command * motor_command
    cube = parameters["cubic"] * (motor_command - MIDDLE) ** 3
    return parameters["offset"] + parameters["slope"] * motor_command + square + cube


_SOURCE = "spread of quadratic thrust maps published for the Crazyflie, as shares of the largest thrust"


# Of the usual commands: about it a cube hardly changes what the curvature means.
MIDDLE = 0.65
_BEND = 0.03  # of the thrust over the usual commands


def bends(value, deviation):
    """Whether a fitted curve bends over the usual commands; if not, it is another thrust or mass."""
    del deviation
    commands = np.linspace(0.45, 0.85, 9)
    cube = value["cubic"] * (commands - MIDDLE) ** 3
    change = (value["offset"] + cube) / commands + value["slope"] + value["curvature"] * commands - 1.0
    return bool(np.ptp(change) > min(0.5 * abs(change.mean()), _BEND))


EFFECT = Effect(
    name="thrust_curve",
    description="thrust follows offset + slope m + curvature m^2 + cubic (m - 0.65)^3 of the motor command m",
    parameters={
        "offset": Parameter("1", 0.0, (-0.05, 0.05), _SOURCE),
        "slope": Parameter("1", 1.0, (0.7, 1.3), _SOURCE),
        "curvature": Parameter("1", 0.0, (-0.3, 0.3), _SOURCE),
        "cubic": Parameter("1", 0.0, (-0.1, 0.1), "what m^1.5 and m^0.7 have beyond a parabola"),
    },
    motor=motor,
    card=Card(
        path="physics",
        fitted=(
            Fitted("offset", mean=0.0, spread=0.08, start=0.02, step=0.001),
            Fitted("slope", mean=1.0, spread=0.2, start=0.95, step=0.001),
            Fitted("curvature", mean=0.0, spread=0.25, start=0.02, step=0.001),
            Fitted("cubic", mean=0.0, spread=0.1, start=0.0, step=0.002),
        ),
        thrust_map=True,
        is_itself=bends,
        sample={"curvature": 0.25},
        next_flight="steps of collective thrust between 40 and 90 %.",
    ),
)
