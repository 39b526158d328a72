"""Checks of what callers hand to `reset` and `step`: shapes and kinds, while a function
is traced, so that they cost nothing once it is compiled.
"""

from typing import Any

import jax
import jax.numpy as jnp

from openjax.errors import UserError


def check_key(function: str, key: Any) -> None:
    """Raise UserError unless `key` is one random key of JAX: () typed, or its raw (2,)
    words.
    """
    kind = getattr(key, "dtype", None)
    if kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key):
        if key.shape == ():
            return
        raise UserError(
            f"{function}(key): keys {key.shape}, but one world takes one key; map it over many "
            f"with jax.vmap({function})"
        )
    if kind is None or kind != jnp.uint32 or jnp.ndim(key) != 1:
        raise UserError(
            f"{function}(key): {_description(key)} is no random key; hand in jax.random.key(0)"
        )


def check_action(action: Any, num_pursuers: int, what: str = "step(key, state, action)") -> None:
    """Raise UserError unless `action` has the shape (num_pursuers, 4)."""
    shape = jnp.shape(action)
    if shape != (num_pursuers, 4):
        raise UserError(
            f"{what}: an action {shape}, but {num_pursuers} pursuers take ({num_pursuers}, 4), "
            "each collective thrust, roll, pitch and yaw rate in -1..1; many worlds are mapped "
            "with jax.vmap"
        )


def _description(value):
    shape = getattr(value, "shape", None)
    return f"{type(value).__name__} {value!r}" if shape is None else f"an array {shape}"
