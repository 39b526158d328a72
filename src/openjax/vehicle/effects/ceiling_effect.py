"""Rotors near the ceiling push more: they pull the vehicle up to it."""

from openjax.vehicle.effects.airspeed import hub_height
from openjax.vehicle.effects.effect import (
    ARENA_CEILING,
    NOT_NEGATIVE,
    Card,
    Effect,
    Fitted,
    Parameter,
)
from openjax.vehicle.effects.ground_effect import gain

# m, twice what is usual: a ceiling that would have to be higher than the room's is some
# slow change of thrust
FARTHEST = 0.06
STRONGEST = 1.5  # the end of the usual range


def thrust(parameters, thrust, reaction, context):
    """The ground effect mirrored at the ceiling, per rotor."""
    distance = context.ceiling_height - hub_height(context)
    return thrust * gain(parameters["strength"], distance + parameters["offset"]), reaction


def above(position) -> bool:
    """True if a flight (T, 3) m was higher than the paper's ceiling: then there is none."""
    return bool((position[:, 2] > ARENA_CEILING).any())


def acts(values, deviations) -> bool:
    """True if a ceiling can be as strong: a stronger one is some slow change of thrust."""
    return values["strength"] < STRONGEST


_SOURCE = "as strong as the ground effect or stronger (Hsiao, Chirarattananon 2019)"

EFFECT = Effect(
    name="ceiling_effect",
    description="thrust grows by strength (R / (distance + offset))^2 near the ceiling, per rotor",
    formula=r"T_i' = T_i\left(1 + s\,\frac{R^2}{(h_c - z_i + \delta)^2}\right)",
    parameters={
        "strength": Parameter("1", 0.0, (0.2, 1.5), _SOURCE, domain=NOT_NEGATIVE),
        "offset": Parameter("m", 0.0, (0.0, 0.03), "distance of the rotors from the tracked point"),
    },
    thrust=thrust,
    card=Card(
        fitted=(
            Fitted(
                "strength", mean=0.0, spread=0.8, start=0.4, step=0.01, sample=0.6, practical=0.08
            ),
            Fitted(
                "offset",
                mean=0.012,
                spread=0.025,
                start=0.012,
                step=0.0005,
                most=FARTHEST,
                sample=0.01,
                shape=True,
            ),
        ),
        others=((0.4, 0.0), (0.4, 0.025), (0.4, 0.05)),
        needs=("position",),
        coordinate="height",
        impossible=above,
        possible=acts,
        next_flight="slow passes just below the ceiling.",
    ),
)
