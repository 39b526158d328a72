"""Axes of one's own: upright, turned about the vertical."""

import jax
import jax.numpy as jnp


def turned_back(heading: jax.Array | None, vector: jax.Array) -> jax.Array:
    """Vectors (..., N, ..., 2 or more) turned about the vertical by minus the yaw with cosine and
    sine `heading` (..., N, 2).
    """
    if heading is None:
        return vector
    axes = (*heading.shape[:-1], *[1] * (vector.ndim - heading.ndim))
    cosine = heading[..., 0].reshape(axes)
    sine = heading[..., 1].reshape(axes)
    x = vector[..., 0]
    y = vector[..., 1]
    xy = jnp.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)
    return jnp.concatenate([xy, vector[..., 2:]], axis=-1)
