"""The step of N drones in one world: controller, motors, effects, body."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from openjax.errors import UserError
from openjax.vehicle.mjx_body import end_of_step_shapes, make_world, mjx_step
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rigid_body import rigid_step, rotate
from openjax.vehicle.rotors import rotor_speed_step, rotor_thrust, rotor_wrench
from openjax.vehicle.state import DroneState

PHYSICS = ("mjx", "rigid")


def make_drones_step(
    physics: str = "mjx", dt: float = 0.01, substeps: int = 1, effects=(), contacts: bool = True
) -> Callable[..., DroneState]:
    """Make the step of N drones of one world: pure, to be mapped over worlds and compiled by the caller.

    physics "mjx": MuJoCo MJX, in which floor, pillars and other drones are solid unless `contacts` is off;
    "rigid": the same free-flight equations written out, nothing is solid. dt is the step in seconds;
    `substeps` divide it, and the rate controller runs in each. `effects` names what is modelled beyond the
    nominal vehicle.

    The step: `drones_step(vehicle, drones, command, pillar_position, pillar_active, effect_parameters) ->
    drones` with drones of leading axis N, command (N, 4) as for `rate_controller`, pillar_position (P, 2) m,
    pillar_active (P,) bool and effect_parameters {effect: {parameter: array}} ({} for none). The arithmetic
    is done in the precision of the drones' state. Within a substep: controller on the present state, motors,
    rotor speeds, wrench from the updated rotor speeds, body.
    """
    if physics not in PHYSICS:
        raise UserError(f"physics {physics!r} is unknown; one of {', '.join(PHYSICS)} would be right")
    if substeps < 1 or dt <= 0:
        raise UserError(f"dt {dt} with {substeps} substeps: dt > 0 and substeps >= 1 would be right")
    sub_dt = dt / substeps

    def motors(vehicle, drone, command):
        """Everything of one drone up to the wrench on its body."""
        motor_command, integral = rate_controller(vehicle, drone, command, sub_dt)
        rotor_speed = rotor_speed_step(vehicle, drone.rotor_speed, motor_command, sub_dt)
        force, torque = rotor_wrench(vehicle, rotor_thrust(vehicle, rotor_speed), rotor_speed)
        moved = drone.replace(
            rotor_speed=rotor_speed, rate_integral=integral, previous_body_rates=drone.body_rates
        )
        return moved, rotate(drone.quaternion, force), torque

    def substep(vehicle, drones, command, pillar_position, pillar_active):
        moved, force, torque = jax.vmap(motors, in_axes=(None, 0, 0))(vehicle, drones, command)
        body = (drones.position, drones.quaternion, drones.velocity, drones.body_rates, force, torque)
        if physics == "rigid":
            body = jax.vmap(lambda *parts: rigid_step(vehicle, *parts, sub_dt))(*body)
        else:
            n = drones.position.shape[0]
            solid = (pillar_position.shape[0], n - 1) if contacts else (0, 0)
            world = make_world(*solid, sub_dt, contacts)
            shapes = end_of_step_shapes(drones, pillar_position, pillar_active, sub_dt) if contacts else None
            step = lambda shape, *parts: mjx_step(world, vehicle, shape, *parts, sub_dt)  # noqa: E731
            body = jax.vmap(step, in_axes=(0 if contacts else None,) + (0,) * 6)(shapes, *body)
        position, quaternion, velocity, body_rates = body
        return moved.replace(
            position=position, quaternion=quaternion, velocity=velocity, body_rates=body_rates
        )

    def drones_step(
        vehicle: Vehicle, drones: DroneState, command, pillar_position, pillar_active, effect_parameters=None
    ) -> DroneState:
        dtype = drones.position.dtype
        vehicle = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), vehicle)
        command = jnp.asarray(command, dtype)
        for _ in range(substeps):
            drones = substep(vehicle, drones, command, pillar_position, pillar_active)
        return drones

    return drones_step
