"""Rows of trees of arrays that share a leading axis: worlds of a batch, slots of a team."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

T = TypeVar("T")


def where_rows(mask: Bool[Array, " rows"], new: T, old: T) -> T:
    """Of two trees (R, ...) the rows of `new` where the mask (R,) holds, else those of
    `old`.
    """

    def select(new_leaf, old_leaf):
        # the mask's axis is the leaf's first one, so all others are of length one
        column = mask.reshape(-1, *[1] * (old_leaf.ndim - 1))
        return jnp.where(column, new_leaf, old_leaf)

    return jax.tree.map(select, new, old)
