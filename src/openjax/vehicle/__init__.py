"""A drone: parameters from its MJCF, rotors, rate controller, dynamics with solids,
optional effects.
"""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "drones": "DronesStep make_drones_step",
        "parameters": (
            "Vehicle hover_rotor_speed hover_share load_vehicle max_rotor_thrust register_airframe"
        ),
        "rigid_body": "quaternion_integrate quaternion_multiply rigid_step rotate rotate_inverse",
        "rotors": "commanded_rotor_speed rotor_reaction rotor_speed_step rotor_thrust total_wrench",
        "state": "DroneState hover_state",
    },
)
