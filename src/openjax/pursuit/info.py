"""Events of a step of one world."""

import jax
from flax import struct

from openjax.pursuit.collisions import Breaches
from openjax.pursuit.shapes import Which
from openjax.pursuit.teams import of_team


@struct.dataclass
class StepInfo:
    """The events of one step, beside the reward."""

    captured: jax.Array
    """(N,) bool: the evader is within the capture radius."""
    seen: jax.Array
    """() bool: some pursuer sees the evader."""
    breaches: Breaches
    """(N,) how many each: of the distance to pillars, to other pursuers, of the arena's
    bounds.
    """
    over_speed: jax.Array
    """(N,) bool: faster than `max_speed`."""
    crashed: jax.Array
    """(N,) bool: touches something, or has tipped over."""
    penalty: jax.Array
    """(N,) the reward's penalties, at most 0."""

    def of_team(self, active: Which | None) -> "StepInfo":
        """The same, where nothing happens to empty slots: `active` (N,) says which
        aren't.
        """
        each = {
            name: of_team(active, getattr(self, name))
            for name in ("captured", "breaches", "over_speed", "crashed")
        }
        return self.replace(**each)
