"""The true state of one drone: all that a simulation carries from step to step."""

from typing import Any

import flax.struct
import jax.numpy as jnp
from jax.typing import ArrayLike

from openjax.vehicle.parameters import Vehicle, hover_rotor_speed
from openjax.vehicle.shapes import Quaternion, Rotors, Vector


@flax.struct.dataclass
class DroneState:
    """One drone; more drones or environments are leading axes. World frame: z up, z = 0
    is the floor.
    """

    position: Vector  # m, world, of the centre of mass
    quaternion: Quaternion  # scalar first, rotates body to world, of unit length
    velocity: Vector  # m/s, world
    body_rates: Vector  # rad/s, body frame
    rotor_speed: Rotors  # rad/s
    rate_integral: Vector  # deg, the rate controller's integrated error
    previous_body_rates: Vector  # rad/s, the rate controller's last measurement
    effect_memory: Any  # pytree of arrays, () when no effect needs memory


def hover_state(
    vehicle: Vehicle,
    position: ArrayLike,
    quaternion: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    effect_memory: Any = (),
) -> DroneState:
    """A drone with its rotors at hover speed, at rest unless `velocity` says otherwise,
    controller reset.

    position (..., 3) m, quaternion (..., 4) (default: level), velocity (..., 3) m/s
    (default: zero); leading axes are broadcast. `effect_memory` comes from
    `openjax.vehicle.effects.initial_memory` where effects need it.
    """
    dtype = vehicle.mass.dtype
    position = jnp.asarray(position, dtype)
    level = (1, 0, 0, 0)
    quaternion = jnp.asarray(level if quaternion is None else quaternion, dtype)
    velocity = jnp.asarray((0, 0, 0) if velocity is None else velocity, dtype)
    lead = jnp.broadcast_shapes(position.shape[:-1], quaternion.shape[:-1], velocity.shape[:-1])
    zeros = jnp.zeros((*lead, 3), dtype)
    return DroneState(
        position=jnp.broadcast_to(position, (*lead, 3)),
        quaternion=jnp.broadcast_to(quaternion, (*lead, 4)),
        velocity=jnp.broadcast_to(velocity, (*lead, 3)),
        body_rates=zeros,
        rotor_speed=jnp.broadcast_to(hover_rotor_speed(vehicle), (*lead, 4)),
        rate_integral=zeros,
        previous_body_rates=zeros,
        effect_memory=effect_memory,
    )
