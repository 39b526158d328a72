"""The fused hidden layer against flax, and its kernel (in interpret mode) against the
formula.
"""

import flax.linen as nn
import jax
import numpy as np
import pytest

from openjax.kernels.activation import activation
from openjax.kernels.normalisation import ROWS, backward_by_kernel, forward_by_kernel, normalise

pytestmark = pytest.mark.slow

FEATURES = 16


def drawn(rows):
    keys = jax.random.split(jax.random.key(0), 3)
    x = 2.0 * jax.random.normal(keys[0], (rows, FEATURES)) + 1.0
    return (
        x,
        jax.random.normal(keys[1], (3, FEATURES)),
        jax.random.normal(keys[2], (rows, FEATURES)),
    )


def flax_layer(x, affine, activate):
    normal = nn.LayerNorm(epsilon=1e-6).apply(
        {"params": {"scale": affine[1], "bias": affine[2]}}, x + affine[0]
    )
    return activation(normal) if activate else normal


@pytest.mark.parametrize("activate", [True, False])
def test_normalise_is_bias_layer_norm_and_activation(activate):
    x, affine, gradient = drawn(20)
    value, pullback = jax.vjp(lambda x, a: normalise(x, a, activate), x, affine)
    expected, expected_pullback = jax.vjp(lambda x, a: flax_layer(x, a, activate), x, affine)
    np.testing.assert_allclose(value, expected, atol=1e-5)
    for got, want in zip(pullback(gradient), expected_pullback(gradient), strict=True):
        np.testing.assert_allclose(got, want, atol=2e-5)


@pytest.mark.parametrize("activate", [True, False])
def test_kernel_computes_the_formula_and_its_gradient(activate):
    x, affine, gradient = drawn(2 * ROWS + 5)  # the last block is only partly filled
    expected, pullback = jax.vjp(lambda x, a: flax_layer(x, a, activate), x, affine)
    value = forward_by_kernel(activate, x, affine, interpret=True)
    np.testing.assert_allclose(value, expected, atol=1e-5)
    gradients = backward_by_kernel(activate, x, affine, gradient, interpret=True)
    for got, want in zip(gradients, pullback(gradient), strict=True):
        np.testing.assert_allclose(got, want, atol=5e-5)
