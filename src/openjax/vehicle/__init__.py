"""A drone: parameters from its MJCF, rotors, rate controller, dynamics with solids, optional effects."""

from openjax.vehicle.drones import DronesStep, make_drones_step
from openjax.vehicle.parameters import Vehicle, hover_rotor_speed, load_vehicle, max_rotor_thrust
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rigid_body import (
    quaternion_integrate,
    quaternion_multiply,
    rigid_step,
    rotate,
    rotate_inverse,
)
from openjax.vehicle.rotors import commanded_rotor_speed, rotor_reaction, rotor_speed_step, rotor_thrust
from openjax.vehicle.state import DroneState, hover_state
from openjax.vehicle.wrench import rotor_wrench, total_wrench

__all__ = [
    "DroneState",
    "DronesStep",
    "Vehicle",
    "commanded_rotor_speed",
    "hover_rotor_speed",
    "hover_state",
    "load_vehicle",
    "make_drones_step",
    "max_rotor_thrust",
    "quaternion_integrate",
    "quaternion_multiply",
    "rate_controller",
    "rigid_step",
    "rotate",
    "rotate_inverse",
    "rotor_reaction",
    "rotor_speed_step",
    "rotor_thrust",
    "rotor_wrench",
    "total_wrench",
]
