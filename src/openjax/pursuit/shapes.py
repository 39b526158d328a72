"""Shapes in types: what the arrays of one world are. More worlds are a leading axis of
all of them, mapped by `jax.vmap`.
"""

from jaxtyping import Array, Bool, Float, Int32

from openjax.vehicle.shapes import Active, Commands, Pillars, Scalar, Team, Vector

__all__ = [
    "Actions",
    "Active",
    "Commands",
    "Count",
    "Each",
    "Flag",
    "Memory",
    "Pillars",
    "Quaternions",
    "Scalar",
    "Team",
    "Vector",
    "Which",
]

Flag = Bool[Array, ""]
Count = Int32[Array, ""]
"""A number of steps, or a place in a list."""
Each = Float[Array, "drones"]
"""A number of each pursuer."""
Which = Bool[Array, "drones"]
"""The pursuers of which something is true."""
Quaternions = Float[Array, "drones 4"]
"""Attitudes of the pursuers, scalar first, from body to world."""
Actions = Float[Array, "drones 4"]
"""Collective thrust, roll, pitch and yaw rate, in -1..1."""
Memory = Float[Array, "memory"]
"""An evader's memory, as numbers."""
