"""Rotors near the ceiling push more: they pull the vehicle up to it."""

from openjax.vehicle.effects.airspeed import hub_height
from openjax.vehicle.effects.effect import Effect, Parameter
from openjax.vehicle.effects.ground_effect import gain


def thrust(parameters, thrust, reaction, context):
    """The ground effect mirrored at the ceiling, per rotor."""
    distance = context.ceiling_height - hub_height(context)
    return thrust * gain(parameters["strength"], distance + parameters["offset"]), reaction


_SOURCE = "as strong as the ground effect or stronger (Hsiao, Chirarattananon 2019)"

EFFECT = Effect(
    name="ceiling_effect",
    description="thrust grows by strength (R / (distance + offset))^2 near the ceiling, per rotor",
    parameters={
        "strength": Parameter("1", 0.0, (0.2, 1.5), _SOURCE),
        "offset": Parameter("m", 0.0, (0.0, 0.03), "distance of the rotors from the tracked point"),
    },
    thrust=thrust,
)
