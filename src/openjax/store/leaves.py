"""Leaves of a pytree of arrays: by their names, by their kinds, and on their devices."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their path, for example `actor/params/Dense_0/kernel`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def place(carry: Any, shardings: Any = None) -> Any:
    """Commit every leaf to its devices, so that a fresh and a restored carry hit the same compiled step.

    Args:
      carry: pytree of arrays.
      shardings: None (the first device) or a sharding or a pytree prefix of them.
    """
    shardings = first_device() if shardings is None else shardings
    if all(sharding.is_fully_addressable for sharding in jax.tree.leaves(shardings)):
        return jax.device_put(carry, shardings)
    # Devices of other processes: each process has the whole carry and hands in its own devices' share.
    is_key = jax.tree.map(lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key), carry)
    arrays = jax.tree.map(
        lambda leaf, key: np.asarray(jax.random.key_data(leaf) if key else leaf), carry, is_key
    )
    implementations = jax.tree.map(
        lambda leaf, key: jax.random.key_impl(leaf) if key else None, carry, is_key
    )

    def whole(arrays):
        return jax.tree.map(
            lambda leaf, key, kind: jax.random.wrap_key_data(leaf, impl=kind) if key else leaf,
            arrays,
            is_key,
            implementations,
        )

    return jax.jit(whole, out_shardings=shardings)(arrays)


def abstract_like(carry: Any, shardings: Any = None) -> Any:
    """Shapes, dtypes and shardings of a carry that `place` put, or would put, on its devices.

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
