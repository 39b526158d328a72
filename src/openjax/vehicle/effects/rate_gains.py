"""The rate controller on board isn't tuned as assumed."""

from openjax.vehicle.effects.effect import Effect, Parameter


def body(parameters, vehicle):
    return vehicle.replace(
        rate_kp=vehicle.rate_kp * parameters["p"],
        rate_ki=vehicle.rate_ki * parameters["i"],
        rate_kd=vehicle.rate_kd * parameters["d"],
    )


_SOURCE = "retuned gains found in labs: half to twice the firmware's"

EFFECT = Effect(
    name="rate_gains",
    description="gains of the rate controller as multiples of the assumed ones",
    parameters={gain: Parameter("1", 1.0, (0.5, 2.0), _SOURCE) for gain in ("p", "i", "d")},
    body=body,
)
