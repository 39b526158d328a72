"""Generalised advantage estimation (Schulman et al., 2016) with terminated and
truncated episodes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def generalised_advantages(
    reward: Float[Array, " steps *worlds"],
    value: Float[Array, " steps *worlds"],
    next_value: Float[Array, " steps *worlds"],
    terminated: Bool[Array, " steps *worlds"],
    truncated: Bool[Array, " steps *worlds"],
    discount: float | Float[Array, "..."],
    trace: float,
) -> Float[Array, " steps *worlds"]:
    """Advantages of consecutive steps.

    Args:
      reward: of each step.
      value: of the state in which the step was taken.
      next_value: of the state it led to, before any reset; ignored where terminated.
      terminated: the episode ended for good: nothing comes after.
      truncated: the episode was cut: the value of the state it led to stands for the
      rest.
      discount: gamma; of all, or of each world.
      trace: lambda.
    """
    # a cut episode has a value after it but no advantage: what came next is another
    # episode's
    goes_on = 1.0 - terminated.astype(reward.dtype)
    error = reward + discount * goes_on * next_value - value
    decay = discount * trace * goes_on * (1.0 - truncated.astype(reward.dtype))

    def backwards(later_advantage, inputs):
        error, decay = inputs
        advantage = error + decay * later_advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(error[0]), (error, decay), reverse=True)
    return advantage
