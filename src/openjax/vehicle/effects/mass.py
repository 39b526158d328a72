"""The vehicle weighs more or less than assumed."""

import numpy as np

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Parameter


def body(parameters, vehicle):
    """Inertia stays: a payload at the centre of mass."""
    return vehicle.replace(mass=vehicle.mass + parameters["extra"])


def some_is_left(vehicle):
    """kg: a vehicle weighs something."""
    return (RATIO[0] - 1.0) * float(vehicle.mass), np.inf


EFFECT = Effect(
    name="mass",
    description="mass differs from what the simulator assumes",
    formula=r"m' = m + \Delta m",
    parameters={
        "extra": Parameter(
            unit="kg",
            none=0.0,
            prior=(-0.005, 0.010),
            source=(
                "Crazyflie 2.x with and without decks and other batteries: 27-42 g, nominal 32.1 g"
            ),
            meaning="mass beyond the assumed one",
            domain=some_is_left,
        )
    },
    body=body,
    card=Card(
        needs=("force", "thrust_map"),
        coordinate="thrust",
        fitted=(
            Fitted(
                "extra",
                mean=0.0,
                spread=0.005,
                start=0.001,
                step=2e-05,
                sample=0.003,
                practical=0.0003,
            ),
        ),
        scales=("motion",),
        weighed=True,
        trim=lambda values, vehicle: np.full(4, -values["extra"] / float(vehicle.mass)),
        next_flight=(
            "weigh the vehicle, then hover and climb hard: a weighed mass leaves only the thrust."
        ),
    ),
)
