"""The learners' networks, plain matrices: every leaf has the axis of the L learners first."""

import jax
import jax.numpy as jnp

WIDTH = 256
"""Of both hidden layers: 100 numbers are sensed, and two layers of 64 gave evaders that ran into
corners.
"""


def init_network(key: jax.Array, learners: int, inputs: int, outputs: int) -> dict[str, jax.Array]:
    """Parameters of L networks whose output is nearly zero at first."""
    sizes = (inputs, WIDTH, WIDTH, outputs)
    scales = (1.0, 1.0, 0.01)
    network = {}
    for i, scale in enumerate(scales):
        key, own = jax.random.split(key)
        shape = (learners, sizes[i], sizes[i + 1])
        network[f"kernel_{i}"] = scale * jax.random.normal(own, shape) / jnp.sqrt(sizes[i])
        network[f"bias_{i}"] = jnp.zeros((learners, 1, sizes[i + 1]))
    return network


def apply_network(network: dict[str, jax.Array], sensed: jax.Array) -> jax.Array:
    """(L, B, outputs) of inputs (L, B, F), each learner's own."""
    hidden = sensed
    for i in range(3):
        hidden = hidden @ network[f"kernel_{i}"] + network[f"bias_{i}"]
        if i < 2:
            hidden = jnp.tanh(hidden)
    return hidden
