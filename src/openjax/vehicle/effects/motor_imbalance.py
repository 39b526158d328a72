"""Rotors differ: bent or worn propellers and motors, each with its own factor on thrust
and torque.
"""

import jax.numpy as jnp
import numpy as np

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter


def thrust(parameters, thrust, reaction, context):
    """Each rotor's own factor on both: a bent propeller changes thrust and torque
    alike.
    """
    factor = 1.0 + jnp.stack([parameters[name] for name in ("m1", "m2", "m3", "m4")])
    return thrust * factor, reaction * factor


STRONGEST = 0.30  # above the rotors' mean, twice what is usual


def flies(values, deviations) -> bool:
    """True if no rotor is stronger than propellers of a kind can be: where torques tell nothing, a
    difference of rotors follows what slow turns do to the thrust.
    """
    return max(values.values()) < STRONGEST


_SOURCE = "spread between motors and propellers: 0.3-15 %"

EFFECT = Effect(
    name="motor_imbalance",
    description="rotor i gives (1 + m_i) times its thrust and torque",
    formula=r"T_i' = (1 + m_i)\,T_i,\quad Q_i' = (1 + m_i)\,Q_i",
    parameters={
        name: Parameter("1", 0.0, (-0.15, 0.15), _SOURCE, domain=(-1.0, jnp.inf))
        for name in ("m1", "m2", "m3", "m4")
    },
    thrust=thrust,
    card=Card(
        fitted=tuple(
            Fitted(
                name, mean=0.0, spread=0.05, start=start, step=0.001, sample=sample, practical=0.002
            )
            for name, start, sample in (
                ("m1", 0.02, 0.06),
                ("m2", -0.01, -0.04),
                ("m3", 0.0, 0.02),
                ("m4", -0.01, -0.05),
            )
        ),
        balanced=True,
        possible=flies,
        days=0.03,
        trim=lambda values, vehicle: np.array([values[m] for m in ("m1", "m2", "m3", "m4")]),
        next_flight="hover and climbs at several thrusts, with yaw free.",
    ),
)
