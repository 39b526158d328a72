"""The networks' activation, as a formula that XLA and the kernels share."""

import jax
import jax.numpy as jnp


def activation(x: jax.Array) -> jax.Array:
    """x sigmoid(1.702 x), the cheap approximation of GELU (Hendrycks and Gimpel, 2016)."""
    return x / (1.0 + jnp.exp(-1.702 * x))


def activation_slope(x: jax.Array) -> jax.Array:
    """Derivative of `activation`."""
    share = 1.0 / (1.0 + jnp.exp(-1.702 * x))
    return share + 1.702 * x * share * (1.0 - share)
