"""Attention of one query per sample over a few entities that are embedded on the fly.

Entities other than the pursuer itself are described by a few numbers each, so their
embeddings, a linear layer and an activation, cost less to compute again than to read
back. On a GPU a hand-written kernel (Pallas, Triton) therefore embeds them in
registers, forward and backward, and nothing as large as samples x entities x features
reaches memory: XLA's own fusions moved several times as many bytes. Elsewhere the same
formula is left to XLA.
"""

import functools

import jax
import jax.numpy as jnp

from openjax.kernels.activation import activation
from openjax.kernels.attention_kernel import backward_by_kernel, forward_by_kernel
from openjax.kernels.attention_operands import Layout, Operands
from openjax.platform import on_platform


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def attend(operands: Operands, layout: Layout) -> jax.Array:
    """Weighted mean of entities for each head, (B, heads * features) in the type of the
    queries.

    Entity 0 is the token; entity m is activation(inverse_m (W' x_m + b) + c) with the
    weights of its kind. With score s_hm = scale * query_h . e_m + bias_m, the result of
    head h is sum_m softmax(s_h)_m e_m.
    """
    return on_platform(_reference, forward_by_kernel, layout)(operands)


def attend_one_by_one(
    queries: list[jax.Array], entities: list[jax.Array], biases: list[jax.Array | float]
) -> list[jax.Array]:
    """The same mean from arrays of their own for every head and entity, as XLA's CPU
    compiler wants them.

    Batches of tiny products are loops without vector instructions there, and so is
    whatever is fused with a slice or a concatenation of entities; sums over features
    and (B, features) arrays alone run at full width.

    Args:
      queries: (B, features) of each head, scaled.
      entities: (B, features) each, the pursuer itself included.
      biases: (B, 1) or a number each, added to an entity's scores.

    Returns:
      (B, features) of each head.
    """
    means = []
    for query in queries:
        scores = [
            jnp.sum(query * e, axis=-1, keepdims=True) + b
            for e, b in zip(entities, biases, strict=True)
        ]
        # the largest score goes out of the quotient, and so needs no gradient
        top = jax.lax.stop_gradient(functools.reduce(jnp.maximum, scores))
        parts = [jnp.exp(score - top) for score in scores]
        inverse = 1.0 / functools.reduce(jnp.add, parts)
        products = [(part * inverse) * e for part, e in zip(parts, entities, strict=True)]
        means.append(functools.reduce(jnp.add, products))
    return means


def _attend_forward(operands, layout):
    return attend(operands, layout), operands


def _attend_backward(layout, operands, gradient):
    backward = on_platform(_reference_backward, backward_by_kernel, layout)
    dquery, dtoken, dinverse, dweights = backward(operands, gradient)
    # what is observed has no gradient here: zeros, as a custom rule must say something
    # for each
    dinputs = jnp.zeros_like(operands.inputs)
    return (Operands(dquery, dtoken, dinputs, dinverse, dweights),)


attend.defvjp(_attend_forward, _attend_backward)


def _reference(layout, operands):
    """The formula as it stands."""
    query, token, inputs, inverse, weights = operands
    batch = token.shape[0]
    entities = [token.astype(jnp.float32)]
    for m, (row, size, weight) in enumerate(layout.entities):
        linear = (
            inputs[row : row + size].T @ weights[weight : weight + size] + weights[weight + size]
        )
        entities.append(activation(inverse[m][:, None] * linear + weights[weight + size + 1]))
    entities = jnp.stack(entities, axis=1)
    heads = query.reshape(batch, layout.heads, layout.features).astype(jnp.float32)
    score = layout.scale * jnp.einsum("bhf,bmf->bhm", heads, entities)
    bias = inputs[layout.input_rows :].T
    score = score + jnp.pad(bias, ((0, 0), (1, 0)))[:, None]
    mean = jnp.einsum("bhm,bmf->bhf", jax.nn.softmax(score, axis=-1), entities)
    return mean.reshape(batch, -1).astype(query.dtype)


def _reference_backward(layout, operands, gradient):
    def of_differentiable(query, token, inverse, weights):
        return _reference(layout, Operands(query, token, operands.inputs, inverse, weights))

    query, token, _, inverse, weights = operands
    _, pullback = jax.vjp(of_differentiable, query, token, inverse, weights)
    return pullback(gradient)
