"""Linear drag of the spinning rotors. It acts at the hubs, so it damps body rates as
well.
"""

import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import hub_velocity, hub_wrench
from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter


def wrench(parameters, context):
    """-d v at each hub, a quarter of the vehicle's drag each."""
    drag = jnp.stack([parameters["d_xy"], parameters["d_xy"], parameters["d_z"]])
    return hub_wrench(context, -0.25 * drag * hub_velocity(context))


_SOURCE = (
    "induced drag of small quadrotors (Foerster 2015 for the Crazyflie; Faessler, Franchi, "
    "Scaramuzza 2018)"
)


def brakes(value, deviation):
    """True unless a fitted drag is clearly a push along the motion: three standard deviations."""
    return bool(value["d_xy"] > -3.0 * deviation["d_xy"])


EFFECT = Effect(
    name="rotor_drag",
    description="force against the hubs' velocity in the body frame",
    formula=r"f_i = -\tfrac14\,\mathrm{diag}(d_{xy}, d_{xy}, d_z)\,v_i",
    parameters={
        "d_xy": Parameter(
            "N s/m",
            0.0,
            (0.005, 0.03),
            _SOURCE,
            "in the rotor plane, all four rotors",
            NOT_NEGATIVE,
        ),
        "d_z": Parameter(
            "N s/m",
            0.0,
            (0.0, 0.03),
            _SOURCE,
            "along the rotor axes, all four rotors",
            NOT_NEGATIVE,
        ),
    },
    wrench=wrench,
    card=Card(
        fitted=(
            Fitted(
                "d_xy",
                mean=0.0,
                spread=0.015,
                start=0.01,
                step=0.0001,
                sample=0.015,
                practical=0.002,
            ),
            Fitted(
                "d_z",
                mean=0.0,
                spread=0.012,
                start=0.005,
                step=0.0001,
                sample=0.005,
                practical=0.003,
            ),
        ),
        needs=("velocity",),
        coordinate="body velocity",
        possible=brakes,
        days=0.0,
        next_flight="fast straight passes in two headings, nose and side first.",
    ),
)
