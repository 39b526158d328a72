"""Thrust is not in proportion to the motor command."""

from openjax.vehicle.effects.effect import Effect, Parameter


def motor(parameters, motor_command, context):
    """offset + slope m + curvature m^2, of which thrust is a linear function."""
    del context
    square = parameters["curvature"] * motor_command * motor_command
    return parameters["offset"] + parameters["slope"] * motor_command + square


_SOURCE = "spread of quadratic thrust maps published for the Crazyflie, as shares of the largest thrust"

EFFECT = Effect(
    name="thrust_curve",
    description="thrust follows offset + slope m + curvature m^2 of the motor command m",
    parameters={
        "offset": Parameter("1", 0.0, (-0.05, 0.05), _SOURCE),
        "slope": Parameter("1", 1.0, (0.7, 1.3), _SOURCE),
        "curvature": Parameter("1", 0.0, (-0.3, 0.3), _SOURCE),
    },
    motor=motor,
)
