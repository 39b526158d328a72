"""Environments spread over devices: what a training step needs to know of the others.

A training step sees its own device's environments only. With `axis=None` there is one
device and these functions do nothing. Everything else (parameters, archive, keys) is
the same on every device.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PRNGKeyArray, Shaped

from openjax.pursuit.teams import team_mean


def mean_over_devices(tree, axis: str | None):
    """Mean of every leaf over all devices, by one collective.

    One for every leaf would cost its latency some thirty times per gradient step.
    """
    if axis is None:
        return tree
    flat, unflatten = ravel_pytree(tree)
    return unflatten(jax.lax.pmean(flat, axis))


def gather_over_devices(tree, axis: str | None):
    """Every leaf with the devices' leading axes joined, in the order of the devices."""
    if axis is None:
        return tree
    return jax.tree.map(lambda x: jax.lax.all_gather(x, axis, tiled=True), tree)


def own_share(x: Shaped[Array, " whole *rest"], axis: str | None) -> Shaped[Array, " share *rest"]:
    """This device's part of an array that all devices have whole."""
    if axis is None:
        return x
    share = x.shape[0] // jax.lax.axis_size(axis)
    first = jax.lax.axis_index(axis) * share
    return jax.lax.dynamic_slice_in_dim(x, first, share)


def own_keys(key: PRNGKeyArray, number: int, axis: str | None) -> Key[Array, " {number}"]:
    """This device's (number,) keys out of one split for all devices: the same ones
    however many devices there are.
    """
    devices = 1 if axis is None else jax.lax.axis_size(axis)
    return own_share(jax.random.split(key, number * devices), axis)


def minibatches(tree, number: int):
    """Leaves (T, E, ...) as (number, E / number, T, ...): whole trajectories of world e
    in minibatch e mod `number`.

    So each device of several holds its share of every minibatch.
    """

    def split(x):
        by_world = jnp.moveaxis(x, 0, 1)
        worlds, *rest = by_world.shape
        rows = by_world.reshape(worlds // number, number, *rest)
        return jnp.moveaxis(rows, 1, 0)

    return jax.tree.map(split, tree)


def joint_moments(
    x: Float[Array, "..."], axis: str | None, mask: jax.Array | None = None
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean () and standard deviation () over all elements on all devices, or those
    in `mask`, bool like x.
    """
    # the mean of the devices' means: all of them have about as many in `mask`
    mean = mean_over_devices(team_mean(mask, x), axis)
    variance = mean_over_devices(team_mean(mask, (x - mean) ** 2), axis)
    return mean, jnp.sqrt(variance)
