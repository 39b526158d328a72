"""Moments of inertia differ from what is assumed, or principal axes from the body's."""

import jax.numpy as jnp

from openjax.vehicle.effects.effect import RATIO, Card, Effect, Fitted, Nuisance, Parameter

AXES = ("xx", "yy", "zz")


def body(parameters, vehicle):
    """The moments; the product of inertia acts as a torque, `wrench`."""
    factor = jnp.stack([parameters[axis] for axis in AXES])
    return vehicle.replace(inertia=vehicle.inertia * factor)


def wrench(parameters, context):
    """The torque under which a body without a product of inertia turns as this one does
    under its rotors: what turns it about x turns it about y as well.
    """
    x, y, _ = context.inertia
    product = parameters["xy"] * jnp.sqrt(x * y / (parameters["xx"] * parameters["yy"]))
    rates = context.body_rates
    zero = jnp.zeros_like(rates[0])
    momentum = product * jnp.stack([rates[1], rates[0], zero])
    gyroscopic = -jnp.cross(rates, momentum)
    up = context.thrust[:, None] * jnp.array([0.0, 0.0, 1.0], rates.dtype)
    torque = jnp.sum(jnp.cross(context.rotor_position, up), axis=0) + gyroscopic
    torque = torque - jnp.cross(rates, context.inertia * rates)
    # diag(x, y) J^-1 is one and this:
    across = product * jnp.stack(
        [product * torque[0] - x * torque[1], product * torque[1] - y * torque[0], zero]
    )
    return jnp.zeros_like(rates), gyroscopic + across / (x * y - product**2)


def heavy_inside(value, deviation):
    """True if the moments are those of a body that holds its mass inside its rotors: a third to
    three times the assumed ones. With all its mass at the hubs, a Crazyflie has 2.1 times the
    nominal moments about x and y. A product turns the principal axes by half a right angle where it
    equals the moments' difference; a sixth of a moment is three times what was measured.
    """
    return all(1 / 3 < value[axis] < 3 for axis in AXES) and abs(value["xy"]) < 1 / 6


_SOURCE = "published values for the Crazyflie, with and without decks: 0.7-1.6 of nominal"

EFFECT = Effect(
    name="inertia",
    description=(
        "moments of inertia as multiples of the assumed ones, and the product about x and y"
    ),
    formula=(
        r"J' = \mathrm{diag}(k_{xx}, k_{yy}, k_{zz})\,J, \quad "
        r"J'_{xy} = k_{xy}\sqrt{J_{xx} J_{yy}}"
    ),
    parameters={axis: Parameter("1", 1.0, (0.7, 1.6), _SOURCE, domain=RATIO) for axis in AXES}
    | {
        "xy": Parameter(
            "1",
            0.0,
            (-0.08, 0.08),
            "a Crazyflie's product is 0.05 of its moments (Forster 2015)",
            "product of inertia J_xy, of the assumed moments",
            (-0.5, 0.5),
        )
    },
    body=body,
    wrench=wrench,
    card=Card(
        torque_axes=(0, 1),
        needs=("thrust_map",),
        possible=heavy_inside,
        fitted=(
            *(
                Fitted(
                    axis,
                    mean=1.0,
                    spread=0.12,
                    start=1.1,
                    step=0.005,
                    sample=1.4,
                    practical=0.05,
                    nuisance=Nuisance(off, duty_cycles=0.2, samples=0.3),
                )
                for axis, off in zip(AXES, (0.04, 0.04, 0.015), strict=True)
            ),
            Fitted(
                "xy",
                mean=0.0,
                spread=0.05,
                start=0.0,
                step=0.002,
                practical=0.03,
                coupling=True,
            ),
        ),
        common=0.3,
        days=0.0,
        next_flight="roll, pitch and yaw doublets with the motor commands logged.",
    ),
)
