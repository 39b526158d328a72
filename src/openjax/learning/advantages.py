"""Generalised advantage estimation (Schulman et al., 2016) with terminated and truncated episodes."""

import jax
import jax.numpy as jnp


def generalised_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    trace: float,
) -> jax.Array:
    """Advantages (T, ...) of T consecutive steps.

    Args:
      reward: (T, ...) of each step.
      value: (T, ...) of the state in which the step was taken.
      next_value: (T, ...) of the state it led to, before any reset; ignored where terminated.
      terminated: (T, ...) bool, the episode ended for good: nothing comes after.
      truncated: (T, ...) bool, the episode was cut: the value of the state it led to stands for the rest.
      discount: gamma.
      trace: lambda.
    """
    goes_on = 1.0 - terminated.astype(reward.dtype)
    error = reward + discount * goes_on * next_value - value
    decay = discount * trace * goes_on * (1.0 - truncated.astype(reward.dtype))

    def backwards(following, inputs):
        error, decay = inputs
        advantage = error + decay * following
        return advantage, advantage

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(error[0]), (error, decay), reverse=True)
    return advantage
