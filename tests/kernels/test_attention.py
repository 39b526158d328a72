"""The folded attention against the textbook's, and the kernel (in interpret mode)
against the plain formula.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.kernels.attention import _reference, _reference_backward
from openjax.kernels.attention_kernel import BLOCK, ROWS, backward_by_kernel, forward_by_kernel
from openjax.kernels.attention_operands import EntityKind, Layout, Operands
from openjax.policy import encoder
from openjax.policy.encoder import SelfAttention, normalised_linear

pytestmark = pytest.mark.slow

FEATURES = 16
HEADS = 4


def shaken(tree, seed, size=0.3):
    """Parameters moved at random, so that zeros and ones at the start hide nothing."""
    leaves, structure = jax.tree.flatten(tree)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    return structure.unflatten(
        [x + size * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    )


def gelu(x):
    return x / (1 + np.exp(-1.702 * x))


def textbook(p, own, others, pillars, seen):
    """softmax(q K' / sqrt(d)) V of one query over all tokens, head by head, in
    float64.
    """
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), p)

    def embedded(x, name):
        linear = x @ p[f"{name}_kernel"] + p[f"{name}_bias"][0]
        centred = linear - linear.mean(-1, keepdims=True)
        normal = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6)
        return gelu(normal * p[f"{name}_scale"] + p[f"{name}_shift"][0])

    tokens = np.concatenate(
        [own[:, None], embedded(others, "others"), embedded(pillars, "pillars")], axis=1
    )
    there = np.concatenate([np.ones((len(own), 1 + others.shape[1]), bool), seen], axis=1)
    query = own @ p["query"]
    keys = tokens @ p["key"]
    values = tokens @ p["value"]
    width = FEATURES // HEADS
    mixed = []
    for head in range(HEADS):
        part = slice(head * width, (head + 1) * width)
        score = np.einsum("bd,bmd->bm", query[:, part], keys[..., part]) / np.sqrt(width)
        score = np.where(there, score, -np.inf)
        weight = np.exp(score - score.max(1, keepdims=True))
        weight /= weight.sum(1, keepdims=True)
        mixed.append(np.einsum("bm,bmd->bd", weight, values[..., part]))
    return np.concatenate(mixed, axis=1) @ p["output"]


@pytest.fixture
def on_machine(monkeypatch):
    """Choose the program for machines with or without CUDA: kernels' formula, or one
    entity at a time.
    """
    return lambda cuda: monkeypatch.setattr(encoder, "can_compile_for_cuda", lambda: cuda)


@pytest.mark.parametrize("cuda", [True, False])
def test_folded_attention_is_multi_head_attention_with_one_query(cuda, on_machine):
    on_machine(cuda)
    draw = np.random.default_rng(0)
    own = draw.normal(size=(7, FEATURES))
    others = draw.normal(size=(7, 2, 3))
    pillars = draw.normal(size=(7, 3, 5))
    seen = draw.uniform(size=(7, 3)) < 0.5
    seen[0], seen[1] = False, True
    pillars[~seen] = -5.0
    module = SelfAttention(FEATURES, HEADS, jnp.float32)
    arguments = [jnp.asarray(x, jnp.float32) for x in (own, others, pillars)] + [jnp.asarray(seen)]
    parameters = shaken(jax.jit(module.init)(jax.random.key(0), *arguments), 1)
    with jax.default_matmul_precision("highest"):
        folded = jax.jit(module.apply)(parameters, *arguments)
    expected = textbook(parameters["params"], own, others, pillars, seen)
    np.testing.assert_allclose(folded, expected, atol=2e-4 * np.abs(expected).max())


def test_both_programs_have_the_same_gradients(on_machine):
    keys = jax.random.split(jax.random.key(4), 4)
    seen = jax.random.uniform(keys[3], (9, 3)) < 0.5
    own, others, pillars = (
        jax.random.normal(k, (9, *s))
        for k, s in zip(keys[:3], [(20,), (2, 3), (3, 5)], strict=True)
    )
    module = encoder.Encoder(FEATURES, HEADS, jnp.float32)
    parameters = shaken(jax.jit(module.init)(jax.random.key(0), own, others, pillars, seen), 1)

    def gradient(cuda):
        on_machine(cuda)

        def loss(parameters, own):
            return jnp.sum(jnp.sin(module.apply(parameters, own, others, pillars, seen)))

        with jax.default_matmul_precision("highest"):
            return jax.jit(jax.grad(loss, argnums=(0, 1)))(parameters, own)

    one_by_one = gradient(cuda=False)
    fused = gradient(cuda=True)
    for (path, a), b in zip(
        jax.tree.leaves_with_path(one_by_one), jax.tree.leaves(fused), strict=True
    ):
        np.testing.assert_allclose(
            a, b, atol=1e-4 * float(jnp.abs(b).max()) + 1e-5, err_msg=str(path)
        )


def test_normalised_linear_is_layer_norm_of_the_linear_layer():
    keys = jax.random.split(jax.random.key(2), 2)
    x = jax.random.normal(keys[0], (50, 5))
    linear = jax.random.normal(keys[1], (6, FEATURES)) + 0.5
    x = x.at[0].set(-5.0).at[1].set(0.0)
    inverse, weights = jax.jit(normalised_linear)(x, linear)
    norm = nn.LayerNorm(epsilon=1e-6, use_bias=False, use_scale=False)
    expected = norm.apply({}, x @ linear[:5] + linear[5])
    got = inverse[:, None] * (x @ weights[:5] + weights[5])
    np.testing.assert_allclose(got, expected, atol=1e-4)


LAYOUT = Layout(FEATURES, HEADS, (EntityKind(2, 3), EntityKind(3, 5)), 0.5)


def operands_of(batch):
    keys = jax.random.split(jax.random.key(batch), 6)
    weights = 0.5 * jax.random.normal(keys[3], (3 + 2 + 5 + 2, FEATURES))
    numbers = jax.random.normal(keys[2], (LAYOUT.input_rows, batch))
    masked = jnp.where(jax.random.uniform(keys[4], (5, batch)) < 0.3, -1e4, 0.0)
    query = jax.random.normal(keys[0], (batch, HEADS * FEATURES))
    token = jax.random.normal(keys[1], (batch, FEATURES))
    inverse = jax.random.uniform(keys[5], (5, batch), minval=0.3, maxval=2.0)
    return Operands(query, token, jnp.concatenate([numbers, masked]), inverse, weights)


def test_kernel_is_the_plain_formula_forward_and_backward():
    batch = BLOCK + 2 * ROWS + 3  # not a multiple of the block
    operands = operands_of(batch)
    gradient = jax.random.normal(jax.random.key(9), operands.query.shape)
    kernel = jax.jit(lambda operands: forward_by_kernel(LAYOUT, operands, interpret=True))
    expected = jax.jit(lambda operands: _reference(LAYOUT, operands))(operands)
    got = kernel(operands)
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, atol=1e-4)

    expected = jax.jit(lambda *a: _reference_backward(LAYOUT, *a))(operands, gradient)
    got = jax.jit(lambda *a: backward_by_kernel(LAYOUT, *a, interpret=True))(operands, gradient)
    for name, a, b in zip(("query", "token", "inverse", "weights"), got, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * float(jnp.abs(b).max() + 1), err_msg=name)
