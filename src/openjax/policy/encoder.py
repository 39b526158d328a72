"""The attention-based observation encoder (the paper's section IV-B, figure 3)."""

import functools
import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from openjax.kernels.attention import attend, attend_one_by_one
from openjax.kernels.attention_operands import EntityKind, Layout, Operands
from openjax.kernels.normalisation import normalise, normalised_layer
from openjax.platform import can_compile_for_cuda

MASKED = -1e4
"""Added to the score of an entity that isn't there, whose weight is then zero in single
precision; finite, since infinities less each other are no numbers.
"""


class SelfAttention(nn.Module):
    """Multi-head attention of the pursuer itself over itself and all other entities.

    Only the own token's output is used, so one query suffices, and the key projection
    is folded into the query's, the value projection into the output's: score and mean
    are taken in the space of the embeddings. Algebraically the same as projecting keys
    and values of every entity (a bias of the keys cancels in the softmax).
    """

    features: int
    heads: int
    dtype: DTypeLike

    @nn.compact
    def __call__(
        self,
        token: jax.Array,
        others: jax.Array,
        pillars: jax.Array,
        pillar_seen: jax.Array,
        others_there: jax.Array | None = None,
    ) -> jax.Array:
        """token (B, F), the pursuer's own embedded; others (B, A, O), pillars (B, k, 5)
        as observed; pillar_seen (B, k) and others_there (B, A) bool, None: all are ->
        (B, F).
        """
        f = self.features
        h = self.heads
        width = f // h
        orthogonal = nn.initializers.orthogonal()

        def kernel(name, shape, init=orthogonal):
            return self.param(name, init, shape, jnp.float32)

        # parameters are the usual four matrices; products of two of them are what is
        # worked with
        query = jnp.einsum(
            "ahd,fhd->ahf",
            kernel("query", (f, f)).reshape(f, h, width),
            kernel("key", (f, f)).reshape(f, h, width),
        )
        output = jnp.einsum(
            "fhd,hdo->hfo",
            kernel("value", (f, f)).reshape(f, h, width),
            kernel("output", (f, f)).reshape(h, width, f),
        )
        pillar_bias = jnp.where(pillar_seen, 0.0, MASKED)
        other_bias = jnp.zeros(others.shape[:-1])
        if others_there is not None:
            other_bias = jnp.where(others_there, 0.0, MASKED)
        entities = []
        for name, x, bias in (("others", others, other_bias), ("pillars", pillars, pillar_bias)):
            if x.shape[-2] > 0:  # a single pursuer has no others
                entities.append((x, *self._embedding(kernel, name, x.shape[-1]), bias))
        if can_compile_for_cuda():
            return self._attend_fused(token, query, output, entities)
        return self._one_by_one(token, query, output, entities)

    def _embedding(self, kernel, name, size):
        """Parameters that embed entities of a kind, of so many numbers: weights with
        the bias in their last row, scale and shift.
        """
        f = self.features
        weights = kernel(f"{name}_kernel", (size, f), nn.initializers.orthogonal(2**0.5))
        bias = kernel(f"{name}_bias", (1, f), nn.initializers.zeros_init())
        scale = kernel(f"{name}_scale", (f,), nn.initializers.ones_init())
        shift = kernel(f"{name}_shift", (1, f), nn.initializers.zeros_init())
        return jnp.concatenate([weights, bias]), scale, shift

    def _one_by_one(self, token, query, output, kinds):
        """Entity by entity and head by head: matrix products of whole batches, which a
        CPU is good at.
        """
        # the pursuer itself is one of the entities, and always there
        embeddings = [token.astype(jnp.float32)]
        biases = [0.0]
        for x, linear, scale, shift, bias in kinds:
            affine = jnp.stack([linear[-1], scale, shift[0]])
            for m in range(x.shape[-2]):
                embeddings.append(normalised_layer(x[:, m], linear[:-1], affine))
                biases.append(bias[:, m : m + 1])
        token = token.astype(self.dtype)
        scale = (self.features // self.heads) ** -0.5
        queries = [
            scale * (token @ query[:, h].astype(self.dtype)).astype(jnp.float32)
            for h in range(self.heads)
        ]
        means = attend_one_by_one(queries, embeddings, biases)
        return sum(
            means[h].astype(self.dtype) @ output[h].astype(self.dtype) for h in range(self.heads)
        )

    def _attend_fused(self, token, query, output, entities):
        """Attend by the kernels for GPUs, or by their formula elsewhere."""
        f = self.features
        h = self.heads
        width = f // h
        kinds = []
        weights = []
        inputs = []
        inverses = []
        biases = []
        for x, linear, scale, shift, bias in entities:
            count, size = x.shape[-2:]
            inverse, linear = normalised_linear(x, linear)
            kinds.append(EntityKind(count, size))
            weights += [linear * scale, shift]
            inputs.append(x.reshape(x.shape[0], count * size))
            inverses.append(inverse)
            biases.append(bias)
        operands = Operands(
            query=token.astype(self.dtype) @ query.reshape(f, h * f).astype(self.dtype),
            token=token,
            inputs=jnp.concatenate(inputs + biases, axis=1).astype(jnp.float32).T,
            inverse=jnp.concatenate(inverses, axis=1).T,
            weights=jnp.concatenate(weights),
        )
        mean = attend(operands, Layout(f, h, tuple(kinds), width**-0.5))
        return mean @ output.reshape(h * f, f).astype(self.dtype)


def normalised_linear(x: jax.Array, linear: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Layer normalisation of a linear layer, without its output.

    Mean and variance over the features of W' x are a linear and a quadratic form of the
    few numbers x, so centred weights and the inverse standard deviation give the
    normalised output.

    Args:
      x: (..., size).
      linear: (size + 1, F), the bias last.

    Returns:
      inverse standard deviations (...) and weights (size + 1, F): their product with
      [x, 1] is LayerNorm(linear' [x, 1]).
    """
    x = jnp.concatenate([x, jnp.ones_like(x[..., :1])], axis=-1)
    deviation = linear - jnp.mean(linear, axis=1, keepdims=True)
    # in full precision: a variance of large and small weights is a difference, and a
    # GPU's products of float32 are rounded to ten bits
    exact = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    covariance = exact(deviation, deviation.T) / linear.shape[1]
    variance = jnp.sum(exact(x, covariance) * x, axis=-1)
    return jax.lax.rsqrt(variance + 1e-6), deviation


class Encoder(nn.Module):
    """Embeds self, other pursuers and pillars by an MLP per kind, attends, adds the
    self embedding, one more MLP.
    """

    features: int
    heads: int
    dtype: DTypeLike

    @nn.compact
    def __call__(
        self,
        self_state: jax.Array,
        others: jax.Array,
        pillars: jax.Array,
        pillar_seen: jax.Array,
        others_there: jax.Array | None = None,
    ) -> jax.Array:
        """self_state (..., S), others (..., A, O), pillars (..., k, 5), pillar_seen
        (..., k) and others_there (..., A) bool, None: all are -> (..., F).
        """
        leading = self_state.shape[:-1]
        rows = len(leading)

        def flat(x):
            # not -1: with a single pursuer there are no others, and nothing to tell the
            # size from
            return x.reshape(math.prod(leading), *x.shape[rows:])

        token = HiddenLayer(self.features, self.dtype, name="self_1")(flat(pad(self_state)))
        token = HiddenLayer(self.features, self.dtype, name="self_2")(token)
        attention = SelfAttention(self.features, self.heads, self.dtype, name="attention")
        others_mask = None if others_there is None else flat(others_there)
        features = token + attention(
            token, flat(others), flat(pillars), flat(pillar_seen), others_mask
        )
        features = normalise(
            features, affine_parameters(self, "norm", self.features), activate=False
        )
        features = HiddenLayer(self.features, self.dtype, name="hidden")(features)
        return features.reshape(*leading, self.features)


class HiddenLayer(nn.Module):
    """Linear layer, layer normalisation and activation."""

    features: int
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """(B, inputs) -> (B, features)."""
        init = nn.initializers.orthogonal(2**0.5)
        kernel = self.param("kernel", init, (x.shape[-1], self.features), jnp.float32)
        affine = affine_parameters(self, "affine", self.features)
        if not can_compile_for_cuda():
            return normalised_layer(x.astype(self.dtype), kernel, affine)
        return normalise(x.astype(self.dtype) @ kernel.astype(self.dtype), affine)


def pad(x: jax.Array) -> jax.Array:
    """(..., S) with zeros up to a multiple of 8: else XLA copies all samples to pad
    them for the matrix unit.
    """
    extra = -x.shape[-1] % 8
    if not extra:
        return x
    return jnp.concatenate([x, jnp.zeros((*x.shape[:-1], extra), x.dtype)], axis=-1)


def affine_parameters(module: nn.Module, name: str, features: int) -> jax.Array:
    """(3, features) bias, scale and shift of a layer, for `normalise`; they start as 0,
    1, 0.
    """

    def start(key, shape, dtype):
        return jnp.zeros(shape, dtype).at[1].set(1.0)

    return module.param(name, start, (3, features), jnp.float32)
