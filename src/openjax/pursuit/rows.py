"""Rows of trees of arrays that share leading axes: worlds of a batch, slots of a team."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

T = TypeVar("T")


def where_rows(mask: Bool[Array, "*rows"], new: T, old: T) -> T:
    """The rows of `new` where the mask holds, and those of `old` elsewhere; the leaves of both
    trees have the mask's axes (...) first.
    """

    def select(new_leaf, old_leaf):
        # all axes after the mask's are of length one
        rows = mask.reshape(*mask.shape, *[1] * (old_leaf.ndim - mask.ndim))
        return jnp.where(rows, new_leaf, old_leaf)

    return jax.tree.map(select, new, old)
