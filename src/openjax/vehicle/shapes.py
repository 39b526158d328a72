"""Shapes in types: what one drone's arrays are. More drones or worlds are leading axes
of all of them, mapped by `jax.vmap`.
"""

from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Quaternion = Float[Array, "4"]
"""Scalar first, of unit length, from body to world."""
Rotors = Float[Array, "4"]
"""In the order of `Vehicle.rotor_position`."""
Command = Float[Array, "4"]
"""Collective thrust in 0..1, a share of four times the largest rotor thrust; roll,
pitch and yaw rate in rad/s.
"""
Commands = Float[Array, "drones 4"]
Hubs = Float[Array, "4 3"]
"""A row of three numbers for each rotor."""
Seconds = float | Scalar
Pillars = Float[Array, "pillars 2"]
"""Axes of the pillar slots (m)."""
Active = Bool[Array, "pillars"]
"""Slots in use."""
Team = Float[Array, "drones 3"]
"""A vector of each drone."""
Others = Float[Array, "others 3"]
"""A vector of each other drone."""
Things = Float[Array, "things 3"]
"""A vector of each solid thing: floor, pillars, other drones."""
Gaps = Float[Array, "things"]
Components = tuple[Gaps, Gaps, Gaps]
"""x, y and z of a vector of each solid thing."""
