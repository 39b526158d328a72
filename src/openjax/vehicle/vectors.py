"""Lengths and directions of vectors."""

import jax
import jax.numpy as jnp

LEAST = 1e-12
"""Added to squared lengths (m^2 or what else they are in): the root's gradient is finite
at zero, too, and a micrometre is less than anything here resolves.
"""


def length(vector: jax.Array, keepdims: bool = False) -> jax.Array:
    """(...) of vectors (..., D), or (..., 1) with `keepdims`."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=keepdims) + LEAST)


def unit(vector: jax.Array) -> jax.Array:
    """(..., D) of length one; (nearly) zero stays zero."""
    return vector / length(vector, keepdims=True)
