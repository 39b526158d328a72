"""The rotors' reaction torque differs from what is assumed, their thrust doesn't."""

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Nuisance, Parameter


def body(parameters, vehicle):
    """The torque constant alone: roll and pitch come from the thrusts, which stay."""
    return vehicle.replace(torque_constant=vehicle.torque_constant * parameters["ratio"])


EFFECT = Effect(
    name="yaw_torque",
    description="torque constant as a multiple of the assumed one",
    formula=r"Q_i' = k\,Q_i",
    parameters={
        "ratio": Parameter(
            unit="1",
            none=1.0,
            prior=(0.15, 2.0),
            source=(
                "torque per thrust of 0.005-0.007 m measured on Crazyflies, against a nominal "
                "0.031 m"
            ),
            domain=RATIO,
        )
    },
    body=body,
    card=Card(
        torque_axes=(2,),
        fitted=(
            Fitted(
                "ratio",
                mean=1.0,
                spread=0.5,
                start=0.9,
                step=0.005,
                sample=0.4,
                practical=0.05,
                nuisance=Nuisance(0.01, duty_cycles=0.5, samples=0.2),
            ),
        ),
        days=0.0,
        next_flight="yaw doublets and steps.",
    ),
)
