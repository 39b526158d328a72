"""What happened in a step of one world."""

import jax
from flax import struct

from openjax.pursuit.collisions import Breaches


@struct.dataclass
class StepInfo:
    """What happened in one step, beside the reward."""

    captured: jax.Array  # (N,) bool
    seen: jax.Array  # () bool, some pursuer sees the evader
    breaches: Breaches
    over_speed: jax.Array  # (N,) bool
    crashed: jax.Array  # (N,) bool
    penalty: jax.Array  # (N,) the reward's penalties, at most 0
