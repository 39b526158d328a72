"""The wake of vehicles above pushes down, at each hub: at the wake's edge it tilts the
vehicle.
"""

import jax
import jax.numpy as jnp

from openjax.vehicle.effects.airspeed import hub_wrench
from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter
from openjax.vehicle.rigid_body import rotate, rotate_inverse


def wrench(parameters, context):
    """-A exp(-dz / h) exp(-r^2 / 2 s^2), s = width + spread dz, along world z; a
    quarter of it at each hub.
    """
    in_world = jax.vmap(lambda r: rotate(context.quaternion, r))(context.rotor_position)
    hubs = in_world + context.position
    separation = context.others_position[None] - hubs[:, None]  # (4, M, 3)
    above = separation[..., 2] > 0.0
    # cut before the exponential as well: of a vehicle far below that could overflow,
    # and the gradient through it be no number
    dz = jnp.where(above, separation[..., 2], 0.0)
    square = separation[..., 0] ** 2 + separation[..., 1] ** 2
    width = parameters["width"] + parameters["spread"] * dz
    strength = jnp.exp(-dz / parameters["length"] - square / (2.0 * width**2))
    # (4,)
    push = -0.25 * parameters["force"] * jnp.sum(jnp.where(above, strength, 0.0), axis=1)
    up = rotate_inverse(context.quaternion, jnp.array([0, 0, 1], context.position.dtype))
    return hub_wrench(context, push[:, None] * up)


_SOURCE = (
    "3-20 g under another Crazyflie, 3-8 cm wide (Shi et al. 2020, Neural-Swarm; Preiss et al. "
    "2017)"
)

EFFECT = Effect(
    name="downwash",
    description=(
        "force along -z under another vehicle, decaying with the distance below it and to the side"
    ),
    formula=r"f = -A\,e^{-\Delta z/h}\,e^{-r^2/2s^2}\,e_z,\quad s = w + b\,\Delta z",
    parameters={
        "force": Parameter(
            "N", 0.0, (0.03, 0.2), _SOURCE, "right under the other vehicle", NOT_NEGATIVE
        ),
        "length": Parameter("m", 0.5, (0.2, 1.0), _SOURCE, "decay below", NOT_NEGATIVE),
        "width": Parameter(
            "m",
            0.05,
            (0.03, 0.08),
            _SOURCE,
            "standard deviation to the side, at the rotors",
            NOT_NEGATIVE,
        ),
        "spread": Parameter(
            "1", 0.1, (0.0, 0.3), "turbulent jets widen by about 0.1 m per m", domain=NOT_NEGATIVE
        ),
    },
    wrench=wrench,
    card=Card(
        fitted=(
            Fitted(
                "force", mean=0.0, spread=0.1, start=0.08, step=0.001, sample=0.05, practical=0.003
            ),
            Fitted("length", mean=0.5, spread=0.25, start=0.5, step=0.005, sample=0.5, shape=True),
            Fitted(
                "width", mean=0.05, spread=0.03, start=0.045, step=0.0005, sample=0.06, shape=True
            ),
            Fitted("spread", mean=0.1, spread=0.06, start=0.1, step=0.002, sample=0.1, shape=True),
        ),
        others=(
            (0.05, 0.8, 0.06, 0.15),
            (0.08, 0.3, 0.03, 0.08),
            (0.1, 0.5, 0.02, 0.03),
            (0.05, 0.5, 0.12, 0.1),
        ),
        needs=("position",),
        of_others=True,
        coordinate="height below a neighbour",
        next_flight="passes of one vehicle 15 to 50 cm above the other.",
    ),
)
