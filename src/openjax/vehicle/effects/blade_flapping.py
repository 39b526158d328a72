"""Flapping blades tilt the thrust against the motion and pitch the body back."""

import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import body_velocity, hub_velocity, hub_wrench
from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter


def wrench(parameters, context):
    """-tilt T_i v_xy at each hub, and the torque stiffness (v x e3)."""
    in_plane = hub_velocity(context) * jnp.array([1, 1, 0], context.velocity.dtype)
    force, torque = hub_wrench(context, -parameters["tilt"] * context.thrust[:, None] * in_plane)
    vx, vy, _ = body_velocity(context)
    return force, torque + parameters["stiffness"] * jnp.stack([vy, -vx, jnp.zeros_like(vx)])


_LEVER = 0.003  # N m: one centimetre of a weight of 0.3 N


def pitches(value, deviation):
    """Whether blades flap: they pitch the body by more than drag a centimetre above its centre of mass would do. If not, it
    is drag. Blades on stiff hubs may do that without tilting the thrust, but then beyond doubt."""
    tilts = value["tilt"] > 3.0 * deviation["tilt"]
    pitches_alone = (
        value["stiffness"] > 5.0 * deviation["stiffness"] and value["tilt"] > -3.0 * deviation["tilt"]
    )
    return bool((tilts or pitches_alone) and value["stiffness"] > _LEVER * max(value["tilt"], 0.0))


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
        ),
        "stiffness": Parameter(
            unit="N m s/m",
            none=0.0,
            prior=(2e-5, 5e-4),
            source="hub moment (Hoffmann et al. 2007), rotor drag 1 cm above the centre of mass",
        ),
    },
    wrench=wrench,
    card=Card(
        path="physics",
        fitted=(
            Fitted("tilt", mean=0.0, spread=0.02, start=0.005, step=0.0001, positive=True),
            Fitted("stiffness", mean=0.0, spread=0.0002, start=3e-05, step=1e-06),
        ),
        needs="velocity",
        coordinate="body velocity",
        commoner=("rotor_drag",),
        is_itself=pitches,
        sample={"tilt": 0.02, "stiffness": 0.0002},
        next_flight="fast straight passes with sudden stops, to load roll and pitch.",
    ),
)
