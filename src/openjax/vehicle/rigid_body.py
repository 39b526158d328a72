"""Free rigid-body flight written out: the same step as MuJoCo's Euler integrator
(semi-implicit).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.shapes import Quaternion, Seconds, Vector
from openjax.vehicle.state import DroneState


def rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """`vector` (3,) of the body frame in the world frame."""
    w = quaternion[0]
    u = quaternion[1:]
    t = 2.0 * cross(u, vector)
    return vector + w * t + cross(u, t)


def rotate_inverse(quaternion: Quaternion, vector: Vector) -> Vector:
    """`vector` (3,) of the world frame in the body frame."""
    w = quaternion[0]
    u = quaternion[1:]
    t = 2.0 * cross(u, vector)
    return vector - w * t + cross(u, t)


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product of two (3,) vectors; written out, since it fuses better than
    `jnp.cross`.
    """
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def quaternion_multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product of two (4,) scalar-first quaternions."""
    return jnp.stack([
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ])  # fmt: skip


def quaternion_integrate(quaternion: Quaternion, body_rates: Vector, dt: Seconds) -> Quaternion:
    """Attitude (4,) after dt seconds at constant body rates (3,) rad/s: exact, and
    smooth at zero rate.
    """
    half = 0.5 * dt * body_rates
    square = jnp.sum(half * half)
    tiny = square < 1e-12  # the series is exact to rounding there
    # 1 in place of a tiny square: at zero the root's slope is infinite, also where it
    # isn't used
    angle = jnp.sqrt(jnp.where(tiny, 1.0, square))
    cosine = jnp.where(tiny, 1.0 - square / 2, jnp.cos(angle))
    sinc = jnp.where(tiny, 1.0 - square / 6, jnp.sin(angle) / angle)
    product = quaternion_multiply(quaternion, jnp.concatenate([cosine[None], sinc * half]))
    # rounding would let the length drift over an episode
    return product * jax.lax.rsqrt(jnp.sum(product * product))


def euler_step(
    drone: DroneState, acceleration: Vector, angular_acceleration: Vector, dt: Seconds
) -> DroneState:
    """Advance velocities by the accelerations (3,) m/s^2 world and (3,) rad/s^2 body,
    then positions by the new velocities: MuJoCo's Euler integrator.
    """
    velocity = drone.velocity + dt * acceleration
    body_rates = drone.body_rates + dt * angular_acceleration
    return drone.replace(
        position=drone.position + dt * velocity,
        quaternion=quaternion_integrate(drone.quaternion, body_rates, dt),
        velocity=velocity,
        body_rates=body_rates,
    )


def accelerations(
    vehicle: Vehicle, drone: DroneState, force_world: Vector, torque_body: Vector
) -> tuple[Vector, Vector]:
    """The accelerations of one drone in free flight, by the Newton-Euler equations: (3,) m/s^2
    world and (3,) rad/s^2 body.

    force_world (3,) N without gravity, torque_body (3,) N m about the centre of mass.
    """
    up = jnp.array([0, 0, 1], force_world.dtype)
    acceleration = force_world / vehicle.mass - vehicle.gravity * up
    momentum = vehicle.inertia * drone.body_rates
    return acceleration, (torque_body - cross(drone.body_rates, momentum)) / vehicle.inertia


def rigid_step(
    vehicle: Vehicle,
    drone: DroneState,
    force_world: Vector,
    torque_body: Vector,
    dt: Seconds,
    contact: Callable[[Vector], Vector] | None = None,
) -> DroneState:
    """One drone after dt seconds, its rotors and controller as they are.

    force_world and torque_body as for `accelerations`. `contact`, if any, maps the
    acceleration (3,) m/s^2 that the drone would have in free flight to what contacts
    add.
    """
    acceleration, angular_acceleration = accelerations(vehicle, drone, force_world, torque_body)
    if contact is not None:
        # as by MJX, gradients are those of free flight: what contacts add is a constant
        # to them
        acceleration = acceleration + jax.lax.stop_gradient(contact(acceleration))
    return euler_step(drone, acceleration, angular_acceleration, dt)
