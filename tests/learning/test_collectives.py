"""Averages over devices: right for every leaf, by one collective for a whole tree."""

import jax
import jax.numpy as jnp
import numpy as np

from openjax.learning.collectives import mean_over_devices

DEVICES = 4


def tree(key):
    """Leaves of several ranks and dtypes, each with the devices' leading axis."""
    keys = jax.random.split(key, 3)
    return {
        "matrix": jax.random.normal(keys[0], (DEVICES, 3, 2)),
        "scalar": jax.random.normal(keys[1], (DEVICES,)),
        "half": jax.random.normal(keys[2], (DEVICES, 5)).astype(jnp.bfloat16),
    }


def test_mean_of_every_leaf():
    values = tree(jax.random.key(0))
    means = jax.vmap(lambda x: mean_over_devices(x, "devices"), axis_name="devices")(values)
    for name, value in values.items():
        assert means[name].dtype == value.dtype
        expected = np.broadcast_to(np.asarray(value, np.float32).mean(0), value.shape)
        tolerance = 1e-6 if value.dtype == jnp.float32 else 1e-2
        np.testing.assert_allclose(np.asarray(means[name], np.float32), expected, atol=tolerance)


def test_one_collective_for_all_parameters():
    leaves = [jnp.zeros((n, 2)) for n in range(1, 20)]
    averaged = jax.make_jaxpr(
        lambda x: mean_over_devices(x, "devices"), axis_env=[("devices", DEVICES)]
    )(leaves)
    assert sum("psum" in equation.primitive.name for equation in averaged.eqns) == 1
