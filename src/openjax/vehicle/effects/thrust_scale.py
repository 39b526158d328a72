"""Every rotor pushes by the same factor more or less, its reaction torque with it."""

import numpy as np

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Nuisance, Parameter


def body(parameters, vehicle):
    """Thrust and torque come from the same air, so the factor is the same."""
    factor = 1.0 + parameters["scale"]
    return vehicle.replace(
        thrust_constant=vehicle.thrust_constant * factor,
        torque_constant=vehicle.torque_constant * factor,
    )


EFFECT = Effect(
    name="thrust_scale",
    description="thrust and rotor torque differ by a common factor 1 + scale",
    formula=r"T_i' = (1 + s)\,T_i,\quad Q_i' = (1 + s)\,Q_i",
    parameters={
        "scale": Parameter(
            unit="1",
            none=0.0,
            prior=(-0.2, 0.2),
            source="spread of published Crazyflie thrust maps and of propellers: 2-20 %",
            domain=(RATIO[0] - 1.0, RATIO[1] - 1.0),
        )
    },
    body=body,
    card=Card(
        needs=("force", "thrust_map"),
        coordinate="thrust",
        fitted=(
            Fitted(
                "scale",
                mean=0.0,
                spread=0.1,
                start=0.02,
                step=0.001,
                sample=-0.08,
                practical=0.01,
                nuisance=Nuisance(0.004, duty_cycles=0.3),
            ),
        ),
        scales=("motion", "torques"),
        days=0.012,
        trim=lambda values, vehicle: np.full(4, values["scale"]),
        next_flight=(
            "weigh the vehicle, then hover and climb hard: a weighed mass leaves only the thrust."
        ),
    ),
)
