"""A delay by any fraction of a step, in a buffer of fixed length, differentiable in the
delay.
"""

import math

import jax
import jax.numpy as jnp

LONGEST_DELAY = 0.1  # s


def buffer_length(dt: float) -> int:
    """Samples needed to look back by LONGEST_DELAY at steps of dt seconds."""
    # one more for the newest sample, and one for the older end of the last
    # interpolation
    return math.ceil(LONGEST_DELAY / dt) + 2


def fill(value, dt: float) -> jax.Array:
    """A buffer (length, *shape), newest first, as if `value` had always been there."""
    return jnp.broadcast_to(value, (buffer_length(dt), *value.shape))


def push(buffer, value) -> jax.Array:
    """The buffer one step later."""
    return jnp.concatenate([value[None], buffer[:-1]])


def look_back(buffer, delay, dt) -> jax.Array:
    """The value `delay` seconds before the newest, interpolated linearly.

    For values that are held over a step this is their mean over the step that starts
    now, which is what a plant driven by the delayed signal integrates. The delay is cut
    to 0..LONGEST_DELAY.
    """
    # not jnp.clip, which has half a slope at its bounds: a fit that starts from no
    # delay needs the whole
    too_long = delay > LONGEST_DELAY
    steps = jnp.where(delay < 0.0, 0.0, jnp.where(too_long, LONGEST_DELAY, delay)) / dt
    steps_floor = jax.lax.stop_gradient(jnp.floor(steps))
    part = steps - steps_floor
    # weights of all samples: in a mapped program each drone looks back by a delay of
    # its own
    index = jnp.arange(buffer.shape[0], dtype=buffer.dtype)
    newer = jnp.where(index == steps_floor, 1.0 - part, 0.0)
    older = jnp.where(index == steps_floor + 1.0, part, 0.0)
    return jnp.tensordot(newer + older, buffer, axes=1)
