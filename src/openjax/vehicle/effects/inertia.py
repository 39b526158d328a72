"""Moments of inertia differ from what is assumed."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Parameter

AXES = ("xx", "yy", "zz")


def body(parameters, vehicle):
    """Principal moments only: the axes stay those of the body."""
    factor = jnp.stack([parameters[axis] for axis in AXES])
    return vehicle.replace(inertia=vehicle.inertia * factor)


def heavy_inside(value, deviation):
    """Whether the moments are those of a body that holds its mass inside its rotors: a
    third to three times the assumed ones. With all its mass at the hubs, a Crazyflie
    has 2.1 times the nominal moments about x and y.
    """
    return all(1 / 3 < value[axis] < 3 for axis in AXES)


_SOURCE = (
    "published values for the Crazyflie, with and without decks: 0.7-1.6 of nominal"
)

EFFECT = Effect(
    name="inertia",
    description="moments of inertia as multiples of the assumed ones",
    formula=r"J' = \mathrm{diag}(k_{xx}, k_{yy}, k_{zz})\,J",
    parameters={
        axis: Parameter("1", 1.0, (0.7, 1.6), _SOURCE, domain=RATIO) for axis in AXES
    },
    body=body,
    card=Card(
        torque_axes=(0, 1),
        thrust_map=True,
        possible=heavy_inside,
        fitted=tuple(
            Fitted(axis, mean=1.0, spread=0.12, start=1.1, step=0.005) for axis in AXES
        ),
        common=0.3,
        nuisance={"xx": 0.04, "yy": 0.04, "zz": 0.015},
        nuisance_duty=dict.fromkeys(AXES, 0.2),
        nuisance_samples=dict.fromkeys(AXES, 0.3),
        sample=dict.fromkeys(AXES, 1.4),
        practical=dict.fromkeys(AXES, 0.05),
        # yaw tells the ratio of torque to the inertia about z
        confirmed_by=(("inertia", "xx"), ("inertia", "yy"), ("yaw_torque", "ratio")),
        # by the replay alone an inertia was right in 1 of 12 development cases
        needs_response=True,
        days=0.0,
        next_flight="roll, pitch and yaw doublets with the motor commands logged.",
    ),
)
