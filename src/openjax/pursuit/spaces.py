"""Spaces of actions and observations: boxes, without another library."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, Shaped


@dataclass(frozen=True)
class Box:
    """Arrays of one shape whose numbers lie between `low` and `high`."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: type = jnp.float32

    def sample(self, key: PRNGKeyArray) -> Shaped[Array, "..."]:
        """Uniform between finite bounds, else normal; booleans by a fair coin."""
        if self.dtype == jnp.bool_:
            return jax.random.bernoulli(key, 0.5, self.shape)
        if np.isfinite(self.low) and np.isfinite(self.high):
            return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)
        # what is unbounded, observations, is of the order of one
        return jax.random.normal(key, self.shape, self.dtype)
