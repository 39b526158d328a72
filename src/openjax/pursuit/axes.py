"""Axes: a body's in the world, and upright ones of one's own, turned about the
vertical.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def rotation_axes(
    quaternion: Float[Array, "*batch 4"],
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
    """Body x and z axes in the world, (..., 3) each, of (..., 4) unit quaternions
    wxyz.
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    body_x = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    body_z = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return body_x, body_z


def turned_back(
    heading: Float[Array, "*batch 2"] | None, vector: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Vectors (..., N, ..., 2 or more) turned about the vertical by minus the yaw with
    cosine and sine `heading` (..., N, 2).
    """
    if heading is None:
        return vector
    # a pursuer's yaw turns all of its vectors: as many axes of one as a vector has more
    axes = (*heading.shape[:-1], *[1] * (vector.ndim - heading.ndim))
    cosine = heading[..., 0].reshape(axes)
    sine = heading[..., 1].reshape(axes)
    x = vector[..., 0]
    y = vector[..., 1]
    xy = jnp.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)
    return jnp.concatenate([xy, vector[..., 2:]], axis=-1)
