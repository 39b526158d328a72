"""Rotors differ: bent or worn propellers and motors, each with its own factor on thrust and torque."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import Effect, Parameter


def thrust(parameters, thrust, reaction, context):
    del context
    factor = 1.0 + jnp.stack([parameters[name] for name in ("m1", "m2", "m3", "m4")])
    return thrust * factor, reaction * factor


_SOURCE = "spread between motors and propellers: 0.3-15 %"

EFFECT = Effect(
    name="motor_imbalance",
    description="rotor i gives (1 + m_i) times its thrust and torque",
    parameters={name: Parameter("1", 0.0, (-0.15, 0.15), _SOURCE) for name in ("m1", "m2", "m3", "m4")},
    thrust=thrust,
)
