"""Rotors: from motor command to speed, thrust and wrench."""

import jax.numpy as jnp

from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.shapes import Rotors, Seconds, Vector

# below this motor command a rotor is asked to stand still: keeps the slope of the
# square root finite
_SMALLEST_COMMAND = 1e-8


def commanded_rotor_speed(vehicle: Vehicle, motor_command: Rotors) -> Rotors:
    """Speed asked for by a motor command in 0..1, which is a share of the largest
    thrust: (4,) rad/s.
    """
    on = motor_command > _SMALLEST_COMMAND
    root = jnp.sqrt(jnp.where(on, motor_command, 1.0))
    return vehicle.max_rotor_speed * jnp.where(on, root, 0.0)


def rotor_speed_step(
    vehicle: Vehicle, rotor_speed: Rotors, motor_command: Rotors, dt: Seconds
) -> Rotors:
    """Rotor speeds after dt seconds of a constant motor command, (4,) rad/s.

    T dw/dt = w_commanded - w, solved exactly; T may differ between speeding up and
    slowing down.
    """
    target = commanded_rotor_speed(vehicle, motor_command)
    slowing = target < rotor_speed
    time_constant = vehicle.motor_time_constant * jnp.where(
        slowing, vehicle.motor_slowdown_ratio, 1.0
    )
    # -expm1(-x) is 1 - exp(-x) without the digits that this loses at short steps
    return rotor_speed + (target - rotor_speed) * -jnp.expm1(-dt / time_constant)


def rotor_thrust(vehicle: Vehicle, rotor_speed: Rotors) -> Rotors:
    """Thrust of each rotor along body z, (4,) N."""
    return vehicle.thrust_constant * jnp.square(rotor_speed)


def rotor_reaction(vehicle: Vehicle, rotor_speed: Rotors) -> Rotors:
    """Reaction torque of each rotor on the body along body z, signed, (4,) N m."""
    return vehicle.rotor_spin * vehicle.torque_constant * jnp.square(rotor_speed)


def total_wrench(vehicle: Vehicle, thrust: Rotors, reaction: Rotors) -> tuple[Vector, Vector]:
    """Force (3,) N and torque about the centre of mass (3,) N m of the rotors, body
    frame.

    thrust (4,) N acts along body z at the hubs; reaction (4,) N m are the signed
    torques of `rotor_reaction`.
    """
    x = vehicle.rotor_position[:, 0]
    y = vehicle.rotor_position[:, 1]
    zero = jnp.zeros_like(thrust[0])
    force = jnp.stack([zero, zero, jnp.sum(thrust)])
    # r x (0, 0, T) = (y T, -x T, 0)
    torque = jnp.stack([jnp.sum(y * thrust), -jnp.sum(x * thrust), jnp.sum(reaction)])
    return force, torque
