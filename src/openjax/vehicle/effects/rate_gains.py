"""The rate controller on board isn't tuned as assumed."""

from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter

GAINS = ("p", "i", "d")


def body(parameters, vehicle):
    """Each gain's factor acts about all three axes."""
    return vehicle.replace(
        rate_kp=vehicle.rate_kp * parameters["p"],
        rate_ki=vehicle.rate_ki * parameters["i"],
        rate_kd=vehicle.rate_kd * parameters["d"],
    )


_SOURCE = "retuned gains found in labs: half to twice the firmware's"

EFFECT = Effect(
    name="rate_gains",
    description="gains of the rate controller as multiples of the assumed ones",
    formula=r"K_P' = k_p K_P,\quad K_I' = k_i K_I,\quad K_D' = k_d K_D",
    parameters={
        gain: Parameter("1", 1.0, (0.5, 2.0), _SOURCE, domain=NOT_NEGATIVE) for gain in GAINS
    },
    body=body,
    card=Card(
        path="rate_loop",
        fitted=tuple(
            Fitted(gain, mean=1.0, spread=0.4, start=1.0, step=0.05, sample=0.65) for gain in GAINS
        ),
        next_flight="roll, pitch and yaw doublets with commands and motor commands logged.",
    ),
)
