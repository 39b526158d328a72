"""The wrench of the four rotors on the body."""

import jax.numpy as jnp

from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rotors import rotor_reaction
from openjax.vehicle.shapes import Rotors, Vector


def total_wrench(vehicle: Vehicle, thrust: Rotors, reaction: Rotors) -> tuple[Vector, Vector]:
    """Force (3,) N and torque about the centre of mass (3,) N m of the rotors, body frame.

    thrust (4,) N acts along body z at the hubs; reaction (4,) N m are the signed torques of `rotor_reaction`.
    """
    x, y = vehicle.rotor_position[:, 0], vehicle.rotor_position[:, 1]
    zero = jnp.zeros_like(thrust[0])
    force = jnp.stack([zero, zero, jnp.sum(thrust)])
    torque = jnp.stack([jnp.sum(y * thrust), -jnp.sum(x * thrust), jnp.sum(reaction)])
    return force, torque


def rotor_wrench(vehicle: Vehicle, thrust: Rotors, rotor_speed: Rotors) -> tuple[Vector, Vector]:
    """`total_wrench` with the reaction torques that go with the rotor speeds (4,) rad/s."""
    return total_wrench(vehicle, thrust, rotor_reaction(vehicle, rotor_speed))
