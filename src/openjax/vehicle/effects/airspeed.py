"""Positions and velocities of the hubs, shared by the effects that act at each rotor."""

import jax
import jax.numpy as jnp

from openjax.vehicle.effects.effect import Context
from openjax.vehicle.rigid_body import cross, rotate, rotate_inverse

PROPELLER_RADIUS = 0.023  # m


def body_velocity(context: Context) -> jax.Array:
    """Velocity of the centre of mass in the body frame, (3,) m/s."""
    return rotate_inverse(context.quaternion, context.velocity)


def hub_velocity(context: Context) -> jax.Array:
    """Velocity of each hub in the body frame, (4, 3) m/s: it moves with the body's
    rates too.
    """
    velocity = body_velocity(context)
    return jax.vmap(lambda r: velocity + cross(context.body_rates, r))(context.rotor_position)


def hub_height(context: Context) -> jax.Array:
    """World height of each hub, (4,) m."""
    in_world = jax.vmap(lambda r: rotate(context.quaternion, r))(context.rotor_position)
    return in_world[:, 2] + context.position[2]


def hub_wrench(context: Context, force) -> tuple[jax.Array, jax.Array]:
    """Total force and torque of forces (4, 3) N at the hubs, body frame."""
    torque = jax.vmap(cross)(context.rotor_position, force)
    return jnp.sum(force, axis=0), jnp.sum(torque, axis=0)
