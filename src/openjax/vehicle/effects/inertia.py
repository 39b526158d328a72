"""Moments of inertia differ from what is assumed."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import Effect, Parameter


def body(parameters, vehicle):
    return vehicle.replace(
        inertia=vehicle.inertia * jnp.stack([parameters[axis] for axis in ("xx", "yy", "zz")])
    )


_SOURCE = "published values for the Crazyflie, with and without decks: 0.7-1.6 of nominal"

EFFECT = Effect(
    name="inertia",
    description="moments of inertia as multiples of the assumed ones",
    parameters={axis: Parameter("1", 1.0, (0.7, 1.6), _SOURCE) for axis in ("xx", "yy", "zz")},
    body=body,
)
