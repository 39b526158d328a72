"""Thrust falls with the battery's voltage: a motor command is a share of what the
battery gives now.
"""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import (
    NOT_NEGATIVE,
    RARE,
    Card,
    Effect,
    Fitted,
    Nuisance,
    Parameter,
)


def voltage(parameters, context):
    """Battery voltage () V: the context's where it is known, else a linear discharge
    from `full`.
    """
    simulation = parameters["full"] - parameters["discharge"] * context.air_time
    is_logged = ~jnp.isnan(context.battery_voltage)
    # a linear discharge crosses zero some day, and a power of a negative ratio is no
    # number
    return jnp.maximum(jnp.where(is_logged, context.battery_voltage, simulation), 1.0)


def motor(parameters, motor_command, context):
    """m (V / V0)^exponent; thrust is a linear function of it."""
    ratio = voltage(parameters, context) / parameters["reference"]
    return motor_command * ratio ** parameters["exponent"]


_CELL = "one-cell LiPo: 4.2 V full, about 3.2 V empty under load, seven minutes of hover"


def frozen(values, intervals, voltage):
    """Values and intervals for a battery that stays at one voltage: nothing is
    discharged.
    """
    return values | {"full": voltage, "discharge": 0.0}, intervals


EFFECT = Effect(
    name="battery_sag",
    description="the motor command loses (V / reference)^exponent",
    formula=r"m' = m\,(V/V_0)^{k}",
    parameters={
        "exponent": Parameter(
            unit="1",
            none=0.0,
            prior=(0.0, 2.0),
            source=(
                "0 with voltage compensation, 2 where speed follows voltage; to 40 % less thrust "
                "empty"
            ),
            domain=NOT_NEGATIVE,
        ),
        "reference": Parameter(
            "V", 3.9, (3.7, 4.2), _CELL, "voltage at which the nominal thrust holds", NOT_NEGATIVE
        ),
        "full": Parameter(
            "V", 4.0, (3.8, 4.15), _CELL, "voltage at take-off, where none is logged", NOT_NEGATIVE
        ),
        "discharge": Parameter(
            "V/s", 0.0017, (0.001, 0.003), _CELL, "loss per second, where none is logged"
        ),
    },
    motor=motor,
    card=Card(
        fitted=(
            Fitted(
                "exponent",
                mean=0.0,
                spread=1.0,
                start=0.5,
                step=0.01,
                sample=1.0,
                practical=0.1,
                nuisance=Nuisance(duty_cycles=0.4),
            ),
            Fitted("reference", mean=3.85, spread=0.15, start=3.85, step=0.01, shape=True),
        ),
        needs=("voltage", "thrust_map"),
        coordinate="voltage",
        scales=("motion", "torques"),
        log_odds=RARE,
        at_voltage=frozen,
        days=0.0,
        next_flight="the same hover on a full and on a nearly empty battery.",
    ),
)
