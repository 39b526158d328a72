"""A world's evader, and its memory."""

import jax
from flax import struct


@struct.dataclass
class EvaderState:
    """The evader of one world, drawn at the start of an episode."""

    kind: jax.Array  # () int32, place in `settings.evaders`
    numbers: dict[str, jax.Array]  # those of `EvaderKind`, () each, float32
    memory: jax.Array  # (M,)
    key: jax.Array | None = None
    """() from which an evader of one's own draws; None where all are shipped ones,
    which don't
    """
