"""Environments spread over devices: what a training step needs to know of the others.

A training step sees its own device's environments only. With `axis=None` there is one device and these functions do
nothing. Everything else (parameters, archive, keys) is the same on every device.
"""

import jax
import jax.numpy as jnp
import numpy as np


def mean_over_devices(tree, axis: str | None):
    """Mean of every leaf over all devices, by one collective for each dtype.

    A collective for every leaf would cost its latency some thirty times per gradient step.
    """
    if axis is None:
        return tree
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    means: list = [None] * len(leaves)
    for dtype in sorted({str(leaf.dtype) for leaf in leaves}):
        same = [i for i, leaf in enumerate(leaves) if str(leaf.dtype) == dtype]
        flat = jax.lax.pmean(jnp.concatenate([leaves[i].ravel() for i in same]), axis)
        ends = np.cumsum([leaves[i].size for i in same])[:-1]
        for i, part in zip(same, jnp.split(flat, ends), strict=True):
            means[i] = part.reshape(leaves[i].shape)
    return structure.unflatten(means)


def gather_over_devices(tree, axis: str | None):
    """Every leaf with the devices' leading axes joined, in the order of the devices."""
    return tree if axis is None else jax.tree.map(lambda x: jax.lax.all_gather(x, axis, tiled=True), tree)


def own_share(x: jax.Array, axis: str | None) -> jax.Array:
    """This device's part of an array that all devices have whole."""
    if axis is None:
        return x
    number = x.shape[0] // jax.lax.axis_size(axis)
    return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(axis) * number, number)


def own_keys(key: jax.Array, number: int, axis: str | None) -> jax.Array:
    """This device's (number,) keys out of one split for all devices: the same ones however many devices there are."""
    devices = 1 if axis is None else jax.lax.axis_size(axis)
    return own_share(jax.random.split(key, number * devices), axis)


def joint_moments(x: jax.Array, axis: str | None) -> tuple[jax.Array, jax.Array]:
    """Mean () and standard deviation () over all elements on all devices."""
    mean = mean_over_devices(jnp.mean(x), axis)
    variance = mean_over_devices(jnp.mean((x - mean) ** 2), axis)
    return mean, jnp.sqrt(variance)
