"""Leaves of a pytree of arrays: by their names, by their kinds, and on their
devices.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their path, for example `actor/params/Dense_0/kernel`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def place(carry: Any, shardings: Any = None) -> Any:
    """Commit every leaf to its devices, so that a fresh and a restored carry hit the
    same compiled step.

    Args:
      carry: pytree of arrays.
      shardings: None (the first device) or a sharding or a pytree prefix of them.
    """
    shardings = first_device() if shardings is None else shardings
    if all(sharding.is_fully_addressable for sharding in jax.tree.leaves(shardings)):
        return jax.device_put(carry, shardings)

    def put(leaf, sharding):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            numbers = put(jax.random.key_data(leaf), sharding)
            return jax.random.wrap_key_data(numbers, impl=jax.random.key_impl(leaf))
        # each process has the whole carry, and hands in its own devices' share
        return jax.make_array_from_callback(leaf.shape, sharding, np.asarray(leaf).__getitem__)

    return jax.tree.map(put, carry, jax.tree.broadcast(shardings, carry))


def abstract_like(carry: Any, shardings: Any = None) -> Any:
    """Shapes, dtypes and shardings of a carry that `place` put, or would put, on its
    devices.

    Args:
      carry: pytree of arrays, or of their shapes and dtypes.
      shardings: as for `place`.
    """
    shardings = first_device() if shardings is None else shardings
    return jax.tree.map(
        lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
        carry,
        jax.tree.broadcast(shardings, carry),
    )


def first_device() -> jax.sharding.Sharding:
    """All of an array on the first device of this process."""
    return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
