"""Flapping blades tilt the thrust against the motion and pitch the body back."""

import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import body_velocity, hub_velocity, hub_wrench
from openjax.vehicle.effects.effect import NOT_NEGATIVE, VERY_RARE, Card, Effect, Fitted, Parameter


def wrench(parameters, context):
    """-tilt T_i v_xy at each hub, and the torque stiffness (v x e3)."""
    in_plane = hub_velocity(context) * jnp.array([1, 1, 0], context.velocity.dtype)
    force, torque = hub_wrench(context, -parameters["tilt"] * context.thrust[:, None] * in_plane)
    vx, vy, _ = body_velocity(context)
    # v x e3 = (vy, -vx, 0): flying forward pitches the nose up, which brakes
    return force, torque + parameters["stiffness"] * jnp.stack([vy, -vx, jnp.zeros_like(vx)])


def tilts_back(value, deviation):
    """True unless blades clearly (three standard deviations) tilt the thrust along the motion, or
    pitch the body forward; without motors in the log nothing says how they pitch it.
    """
    return all(value[name] > -3.0 * deviation[name] for name in ("tilt", "stiffness"))


EFFECT = Effect(
    name="blade_flapping",
    description="thrust tilts back with airspeed, and the hubs pass on a torque",
    formula=r"f_i = -\tau\,T_i\,v_{i,xy},\quad M = \kappa\,(v \times e_3)",
    parameters={
        "tilt": Parameter(
            unit="rad s/m",
            none=0.0,
            prior=(0.0, 0.05),
            source="tilt of the tip-path plane per airspeed (Mahony, Kumar, Corke 2012)",
            domain=NOT_NEGATIVE,
        ),
        "stiffness": Parameter(
            unit="N m s/m",
            none=0.0,
            prior=(2e-5, 5e-4),
            source="hub moment (Hoffmann et al. 2007), rotor drag 1 cm above the centre of mass",
            domain=NOT_NEGATIVE,
        ),
    },
    wrench=wrench,
    card=Card(
        fitted=(
            Fitted(
                "tilt",
                mean=0.0,
                spread=0.02,
                start=0.005,
                step=0.0001,
                sample=0.02,
                # as much force as the drag that matters: a smaller one stood in for small
                # drags
                practical=0.006,
            ),
            Fitted(
                "stiffness",
                mean=0.0,
                spread=0.0002,
                start=3e-05,
                step=1e-06,
                sample=0.0002,
                practical=1e-05,
            ),
        ),
        needs=("velocity",),
        coordinate="body velocity",
        log_odds=VERY_RARE,
        possible=tilts_back,
        next_flight="fast straight passes with sudden stops, to load roll and pitch.",
    ),
)
