"""Rotors top out early: a one-sided limit that may fall with the battery."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Parameter

_REFERENCE_VOLTAGE = 3.9  # V


def motor(parameters, motor_command, context):
    """min(m, limit), before the motors' lag: a saturated motor leaves its limit as soon
    as the command does.
    """
    # where nobody knows the voltage, the limit is that at the reference
    voltage = context.battery_voltage
    excess = jnp.where(jnp.isnan(voltage), 0.0, voltage - _REFERENCE_VOLTAGE)
    limit = parameters["limit"] * (1.0 + parameters["voltage_slope"] * excess)
    return jnp.minimum(motor_command, limit)


def tops_out(value, deviation):
    """True if full commands reach the limit; above 1 it is a thrust curve's form."""
    return value["limit"] < 1.0


def frozen(values, intervals, voltage):
    """The limit as it is at one voltage."""
    factor = 1.0 + values["voltage_slope"] * (voltage - _REFERENCE_VOLTAGE)
    limit = tuple(factor * v for v in intervals["limit"])
    return values | {"limit": values["limit"] * factor, "voltage_slope": 0.0}, {"limit": limit}


EFFECT = Effect(
    name="thrust_saturation",
    description="no rotor gives more than a share of the nominal largest thrust",
    formula=r"m' = \min\left(m,\ \ell\,(1 + \beta\,(V - V_0))\right)",
    parameters={
        "limit": Parameter(
            unit="1",
            # out of reach: what a curve or a full battery gives beyond the nominal
            # largest thrust stays
            none=1.5,
            prior=(0.6, 0.95),
            source="brushed motors on a worn battery top out 10-30 % early",
            meaning="largest thrust as a share of the nominal one, at 3.9 V",
            domain=RATIO,
        ),
        "voltage_slope": Parameter(
            unit="1/V",
            none=0.0,
            prior=(0.0, 0.5),
            source="thrust at full duty follows the square of the voltage: 2 / 3.9 V",
            meaning="relative change of the limit per volt above 3.9 V, where the voltage is known",
        ),
    },
    motor=motor,
    card=Card(
        coordinate="thrust",
        fitted=(
            Fitted("limit", mean=0.8, spread=0.12, start=0.8, step=0.002, sample=0.82),
            Fitted("voltage_slope", mean=0.0, spread=0.1, start=0.0, step=0.01),
        ),
        # a limit that no command reaches has no slope, so the search starts from many
        others=(
            (0.95, 0.0),
            (0.92, 0.0),
            (0.89, 0.0),
            (0.865, 0.0),
            (0.84, 0.0),
            (0.76, 0.0),
            (0.7, 0.0),
        ),
        needs=("thrust_map",),
        scales=("torques",),
        possible=tops_out,
        at_voltage=frozen,
        next_flight="short full-thrust climbs.",
    ),
)
