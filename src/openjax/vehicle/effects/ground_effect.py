"""Rotors near the floor push more."""

import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import PROPELLER_RADIUS, hub_height
from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter


def gain(strength, distance):
    """1 + strength (R / distance)^2 for hubs at `distance` m from a plane."""
    # nearer than half a radius the formula holds no more, and at the plane it is
    # infinite
    height = jnp.maximum(distance, 0.5 * PROPELLER_RADIUS)
    return 1.0 + strength * (PROPELLER_RADIUS / height) ** 2


def thrust(parameters, thrust, reaction, context):
    """Each hub has its own height, so that a tilted vehicle is righted or turned
    over.
    """
    height = hub_height(context) - context.floor_height
    return thrust * gain(parameters["strength"], height + parameters["offset"]), reaction


# several times what is usual, with the rotors at the plane: more is some slow change of
# thrust
STRONGEST = 3.0


def acts(values, deviations) -> bool:
    """True if a floor can be as strong; asked at the height of one rotor's radius, as strength and
    offset trade against each other.
    """
    height = PROPELLER_RADIUS + values["offset"]
    return values["strength"] * (PROPELLER_RADIUS / height) ** 2 < STRONGEST


_SOURCE = (
    "5-25 % at 5 cm (Cheeseman-Bennett form with free strength; Sanchez-Cuevas et al. 2017 for "
    "multirotors)"
)

EFFECT = Effect(
    name="ground_effect",
    description="thrust grows by strength (R / (z + offset))^2 near the floor, per rotor",
    formula=r"T_i' = T_i\left(1 + s\,\frac{R^2}{(z_i + \delta)^2}\right)",
    parameters={
        "strength": Parameter("1", 0.0, (0.2, 1.2), _SOURCE, domain=NOT_NEGATIVE),
        "offset": Parameter(
            "m", 0.0, (0.0, 0.03), "height of the rotors above the tracked point, mocap offset"
        ),
    },
    thrust=thrust,
    card=Card(
        fitted=(
            Fitted(
                "strength", mean=0.0, spread=0.8, start=0.4, step=0.01, sample=0.8, practical=0.08
            ),
            Fitted(
                "offset", mean=0.012, spread=0.01, start=0.012, step=0.0005, sample=0.01, shape=True
            ),
        ),
        others=((0.4, 0.0), (0.4, 0.025), (0.4, 0.05)),
        needs=("position",),
        coordinate="height",
        possible=acts,
        next_flight="slow passes between 3 and 20 cm above the floor.",
    ),
)
