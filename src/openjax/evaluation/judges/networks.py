"""The learners' networks, plain matrices: every leaf has the axis of the L learners
first.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

Network = dict[str, jax.Array]


def init_network(key: jax.Array, widths: Sequence[int], sizes: tuple[int, int]) -> Network:
    """Parameters of networks whose output is nearly zero at first, one for each of the
    `widths` of both hidden layers; of as many inputs and outputs as `sizes` say.

    All have as many units as the widest. Those that a narrower one hasn't got begin
    with zeros before and behind them, which have no gradient, and so stay without use.
    """
    inputs, outputs = sizes
    learners = len(widths)
    width = max(widths)
    is_unit = jnp.arange(width) < jnp.asarray(widths)[:, None]  # (L, width)
    sizes = (inputs, width, width, outputs)
    scales = (1.0, 1.0, 0.01)
    network = {}
    for i, scale in enumerate(scales):
        key, layer_key = jax.random.split(key)
        shape = (learners, sizes[i], sizes[i + 1])
        kernel = scale * jax.random.normal(layer_key, shape)
        if i > 0:
            kernel = jnp.where(is_unit[:, :, None], kernel, 0.0)
            kernel /= jnp.sqrt(jnp.asarray(widths, jnp.float32))[:, None, None]
        else:
            kernel /= jnp.sqrt(inputs)
        if i < 2:
            kernel = jnp.where(is_unit[:, None], kernel, 0.0)
        network[f"kernel_{i}"] = kernel
        network[f"bias_{i}"] = jnp.zeros((learners, 1, sizes[i + 1]))
    return network


def apply_network(network: Network, senses: jax.Array) -> jax.Array:
    """(L, B, outputs) of inputs (L, B, F), each learner's own."""
    features = senses
    for i in range(3):
        features = features @ network[f"kernel_{i}"] + network[f"bias_{i}"]
        if i < 2:
            features = jnp.tanh(features)
    return features


def ways(outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(..., W, 3) means and (..., W) log odds of the ways that outputs (..., 4 W) say;
    three outputs are one way.
    """
    number = outputs.shape[-1]
    if number == 3:
        return outputs[..., None, :], jnp.zeros((*outputs.shape[:-1], 1), outputs.dtype)
    means, odds = outputs[..., : number // 4 * 3], outputs[..., number // 4 * 3 :]
    return means.reshape(*odds.shape, 3), jax.nn.log_softmax(odds)


def of_way(means: jax.Array, way: jax.Array) -> jax.Array:
    """(..., 3) of means (..., W, 3) the one at `way` (...,), int."""
    return jnp.take_along_axis(means, way[..., None, None], axis=-2)[..., 0, :]


def likeliest(outputs: jax.Array) -> jax.Array:
    """(..., 3) the mean of the way with the best odds."""
    means, odds = ways(outputs)
    return of_way(means, jnp.argmax(odds, axis=-1))
