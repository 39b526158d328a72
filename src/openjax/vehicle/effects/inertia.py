"""Moments of inertia differ from what is assumed."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter
from openjax.vehicle.effects.motor_lag import EARLY


def body(parameters, vehicle):
    return vehicle.replace(
        inertia=vehicle.inertia * jnp.stack([parameters[axis] for axis in ("xx", "yy", "zz")])
    )


def resists(value, deviation):
    """Whether the body resists the motors. One that seems heavy to turn and yet turns before its motors act is pushed by
    what its rate controller answers: in closed loop, gusts look like weak and early motors, though by no more than there are
    gusts. A few per cent are what the replay's own step leaves of a torque."""
    if max(abs(value[axis] - 1.0) for axis in ("xx", "yy", "zz")) < _LEAST:
        return False
    if max(value["xx"], value["yy"]) - 1.0 > _FEIGNED * value["gusts"] > 0.0:
        return True
    lag = 0.5 * (value["motor_lag.extra_up"] + value["motor_lag.extra_down"])
    early, sure = lag < -EARLY, lag < -3.0 * deviation["motor_lag.extra_up"]
    return not (early and sure and max(value["xx"], value["yy"], value["zz"]) > 1.0)


_LEAST = 0.05  # of the moments
_FEIGNED = 4.0  # heavier than so many times the gusts' share of the torques, a body is heavy
_SOURCE = "published values for the Crazyflie, with and without decks: 0.7-1.6 of nominal"

EFFECT = Effect(
    name="inertia",
    description="moments of inertia as multiples of the assumed ones",
    formula=r"J' = \mathrm{diag}(k_{xx}, k_{yy}, k_{zz})\,J",
    parameters={axis: Parameter("1", 1.0, (0.7, 1.6), _SOURCE) for axis in ("xx", "yy", "zz")},
    body=body,
    card=Card(
        path="physics",
        torque_axes=(0, 1),
        fitted=(
            Fitted("xx", mean=1.0, spread=0.12, start=1.1, step=0.005),
            Fitted("yy", mean=1.0, spread=0.12, start=1.1, step=0.005),
            Fitted("zz", mean=1.0, spread=0.12, start=1.1, step=0.005),
        ),
        common=0.3,
        beside=("motor_lag",),
        is_itself=resists,
        sample={"xx": 1.4, "yy": 1.4, "zz": 1.4},
        next_flight="roll, pitch and yaw doublets with the motor commands logged.",
    ),
)
