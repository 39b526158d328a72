"""The vehicle weighs more or less than assumed."""

from openjax.vehicle.effects.effect import Effect, Parameter


def body(parameters, vehicle):
    """Inertia stays: a payload at the centre of mass."""
    return vehicle.replace(mass=vehicle.mass + parameters["extra"])


EFFECT = Effect(
    name="mass",
    description="mass differs from what the simulator assumes",
    parameters={
        "extra": Parameter(
            unit="kg",
            none=0.0,
            prior=(-0.005, 0.010),
            source="Crazyflie 2.x with and without decks and other batteries: 27-42 g, nominal 32.1 g",
            meaning="mass beyond the assumed one",
        )
    },
    body=body,
)
