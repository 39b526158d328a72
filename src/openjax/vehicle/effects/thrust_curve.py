"""Thrust is not in proportion to the motor command."""

import numpy as np

from openjax.vehicle.effects.effect import RARE, Card, Effect, Fitted, Nuisance, Parameter


def motor(parameters, motor_command, context):
    """offset + slope m + curvature m^2; thrust is a linear function of it."""
    square = parameters["curvature"] * motor_command * motor_command
    return parameters["offset"] + parameters["slope"] * motor_command + square


_SOURCE = (
    "spread of quadratic thrust maps published for the Crazyflie, as shares of the largest thrust"
)

# A straight line rises by 1; these are what powers of the command from 0.6 to 1.9 rise
# by.
_LEAST_SLOPE = 0.4
_LARGEST_SLOPE = 2.2
_USUAL_COMMANDS = np.array([0.45, 0.85])


# 1 % of the thrust at the ends of the usual commands
LEAST_BEND = 0.004


def rises(value, deviation):
    """True if a fitted curve rises over the usual commands as a motor's does; if not, the motors
    don't make this force.
    """
    slope = value["slope"] + 2.0 * value["curvature"] * _USUAL_COMMANDS
    return bool(_LEAST_SLOPE < slope.min() and slope.max() < _LARGEST_SLOPE)


def bend():
    """(n, 3): by what share of the thrust offset, slope and curvature bend the map over
    the usual commands, beside the straight line through zero that fits best, which is a
    thrust scale; their root mean square is in units of LEAST_BEND.
    """
    commands = np.linspace(*_USUAL_COMMANDS, 9)
    columns = np.stack([np.ones_like(commands), commands, commands**2], 1)
    line = commands / np.linalg.norm(commands)
    columns = columns - np.outer(line, line @ columns)
    return columns / (commands.mean() * LEAST_BEND * np.sqrt(len(commands)))


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
        coordinate="thrust",
        fitted=(
            Fitted(
                "offset",
                mean=0.0,
                spread=0.08,
                start=0.02,
                step=0.001,
                nuisance=Nuisance(duty_cycles=0.15),
            ),
            Fitted("slope", mean=1.0, spread=0.2, start=0.95, step=0.001),
            Fitted(
                "curvature",
                mean=0.0,
                spread=0.25,
                start=0.02,
                step=0.001,
                error=0.1,
                sample=0.25,
                nuisance=Nuisance(duty_cycles=0.3),
            ),
        ),
        needs=("thrust_map",),
        scales=("motion", "torques"),
        log_odds=RARE,
        possible=rises,
        departure=bend,
        days=0.0,
        next_flight="steps of collective thrust between 40 and 90 %.",
    ),
)
