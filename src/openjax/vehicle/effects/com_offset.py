"""The centre of mass isn't amid the rotors: thrust turns the body."""

import jax.numpy as jnp
import numpy as np

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter


def body(parameters, vehicle):
    """Positions and velocities of the state are those of the centre of mass, wherever
    it is.
    """
    # the body frame's origin is the centre of mass: seen from it the rotors move the
    # other way
    offset = jnp.stack([parameters["x"], parameters["y"], parameters["z"]])
    return vehicle.replace(rotor_position=vehicle.rotor_position - offset)


def as_rotors(values, vehicle):
    """(4,) shares of the rotors' thrust that turn the body as much."""
    places = np.asarray(vehicle.rotor_position, float)[:, :2]
    # a centre of mass farther forward is as if the front rotors pushed less
    return -places @ (np.array([values["x"], values["y"]]) / np.mean(np.square(places), 0))


_SOURCE = "battery and decks shift it by 0.05-8 mm"

EFFECT = Effect(
    name="com_offset",
    description="centre of mass away from the middle of the rotors, body frame",
    formula=r"r_i' = r_i - c",
    parameters={
        "x": Parameter("m", 0.0, (-0.008, 0.008), _SOURCE, "forward"),
        "y": Parameter("m", 0.0, (-0.008, 0.008), _SOURCE, "left"),
        "z": Parameter(
            "m", 0.0, (-0.01, 0.01), _SOURCE, "up; felt only through forces in the rotor plane"
        ),
    },
    body=body,
    card=Card(
        fitted=(
            Fitted(
                "x", mean=0.0, spread=0.002, start=0.0003, step=2e-05, sample=0.003, practical=4e-05
            ),
            Fitted(
                "y",
                mean=0.0,
                spread=0.002,
                start=0.0003,
                step=2e-05,
                sample=-0.002,
                practical=4e-05,
            ),
        ),
        days=0.0,
        trim=as_rotors,
        next_flight="hover and climbs at several thrusts, with yaw free.",
    ),
)
