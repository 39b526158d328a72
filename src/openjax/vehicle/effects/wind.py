"""Steady wind: a force fixed in the world, so it turns with yaw in the body frame and
persists at rest.
"""

import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import hub_velocity, hub_wrench
from openjax.vehicle.effects.effect import NOT_NEGATIVE, VERY_RARE, Card, Effect, Fitted, Parameter
from openjax.vehicle.rigid_body import rotate_inverse


def wrench(parameters, context):
    """-drag (v - w) at the hubs, a share of it along the rotors' axes: rotor drag in air that
    moves.
    """
    in_world = jnp.stack([parameters["x"], parameters["y"], parameters["z"]])
    wind = rotate_inverse(context.quaternion, in_world)
    drag = parameters["drag"] * jnp.stack([1.0, 1.0, parameters["along"]])
    return hub_wrench(context, -0.25 * drag * (hub_velocity(context) - wind))


STEEPEST = 2.0  # times as much drag along the rotors' axes, twice what is usual
LEAST_DRAG = 0.001  # N s/m, below which none is told
FASTEST_UP = 1.0  # m/s, the end of the usual range
LEVEL = 0.2  # of the wind's speed that may rise or fall: a fan isn't quite level

_SOURCE = "indoor draughts and fans, 0.3-3 m/s"


def drags(value, deviation):
    """True if air that moves drags the vehicle along, along the rotors' axes too and not
    much more there, and rises no faster than draughts do or than a strong wind that is
    nearly level: a thrust that isn't known looks like a gale from below.
    """
    level = LEVEL * (value["x"] ** 2 + value["y"] ** 2) ** 0.5
    return bool(
        value["drag"] > 0.0
        and 0.0 < value["along"] < STEEPEST
        and abs(value["z"]) < max(FASTEST_UP, level)
    )


def by_its_drag(value):
    """The drag in still air, in air that moves."""
    drag = max(value["d_xy"], LEAST_DRAG)
    return {"drag": drag, "along": max(value["d_z"], 0.0) / drag}


EFFECT = Effect(
    name="wind",
    description="drag against air that moves with a constant velocity in the world frame",
    formula=r"f_i = -\tfrac14\,d\,\mathrm{diag}(1, 1, a)\,(v_i - w)",
    parameters={
        "x": Parameter("m/s", 0.0, (-3.0, 3.0), _SOURCE, "velocity of the air"),
        "y": Parameter("m/s", 0.0, (-3.0, 3.0), _SOURCE, "velocity of the air"),
        "z": Parameter("m/s", 0.0, (-1.0, 1.0), _SOURCE, "velocity of the air"),
        "drag": Parameter("N s/m", 0.0, (0.005, 0.03), "as for rotor_drag", domain=NOT_NEGATIVE),
        "along": Parameter(
            "1",
            1.0,
            (0.3, 1.0),
            "as for rotor_drag",
            "share of the drag along the rotors' axes",
            NOT_NEGATIVE,
        ),
    },
    wrench=wrench,
    card=Card(
        fitted=(
            Fitted("x", mean=0.0, spread=1.5, start=0.3, step=0.01, sample=1.2, practical=0.1),
            Fitted("y", mean=0.0, spread=1.5, start=0.3, step=0.01, sample=-0.8, practical=0.1),
            # no practical number: air that moves along z pushes as a wrong thrust does
            Fitted("z", mean=0.0, spread=0.5, start=0.0, step=0.01),
            Fitted("drag", mean=0.013, spread=0.006, start=0.013, step=0.0001, sample=0.015),
            Fitted("along", mean=0.8, spread=0.4, start=1.0, step=0.01),
        ),
        needs=("velocity",),
        coordinate="body velocity",
        log_odds=VERY_RARE,
        possible=drags,
        takes_over=("rotor_drag", by_its_drag),
        next_flight="hover, turning slowly through a full circle of yaw.",
    ),
)
