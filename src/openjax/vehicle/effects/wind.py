"""Steady wind: a force fixed in the world, so it turns with yaw in the body frame and persists at rest."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import Effect, Parameter
from openjax.vehicle.rigid_body import rotate_inverse


def wrench(parameters, context):
    """-drag (v - w), at the centre of mass."""
    wind = jnp.stack([parameters["x"], parameters["y"], parameters["z"]])
    force = -parameters["drag"] * (context.velocity - wind)
    return rotate_inverse(context.quaternion, force), jnp.zeros_like(force)


_SOURCE = "indoor draughts and fans, 0.3-3 m/s"

EFFECT = Effect(
    name="wind",
    description="drag against air that moves with a constant velocity in the world frame",
    parameters={
        "x": Parameter("m/s", 0.0, (-3.0, 3.0), _SOURCE, "velocity of the air"),
        "y": Parameter("m/s", 0.0, (-3.0, 3.0), _SOURCE, "velocity of the air"),
        "z": Parameter("m/s", 0.0, (-1.0, 1.0), _SOURCE, "velocity of the air"),
        "drag": Parameter("N s/m", 0.0, (0.005, 0.03), "as for rotor_drag, isotropic"),
    },
    wrench=wrench,
)
