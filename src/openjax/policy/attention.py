"""Attention of one query per sample over a few entities that are embedded on the fly.

Entities other than the pursuer itself are described by a few numbers each, so their embeddings, a linear layer and an
activation, cost less to compute again than to read back. On a GPU a hand-written kernel (Pallas, Triton) therefore
embeds them in registers, forward and backward, and nothing as large as samples x entities x features reaches memory:
XLA's own fusions moved several times as many bytes (experiments/performance.md). Elsewhere the same formula is left
to XLA.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.platform import on_platform, whole_blocks
from openjax.policy.activation import activation, activation_slope

ROWS = 8
"""Samples that one program of the kernel works on; with more, the backward kernel's registers spill (3 times slower)."""

WARPS = 4


class EntityKind(NamedTuple):
    """Entities of one kind: `count` of them, `size` numbers each."""

    count: int
    size: int


class Layout(NamedTuple):
    """Static sizes of the attention."""

    features: int
    heads: int
    kinds: tuple[EntityKind, ...]
    scale: float

    @property
    def entities(self) -> list[tuple[int, int, int]]:
        """(row of the first input, size, row of the first weight) of every entity but the pursuer itself."""
        rows, row, weight = [], 0, 0
        for kind in self.kinds:
            for _ in range(kind.count):
                rows.append((row, kind.size, weight))
                row += kind.size
            weight += kind.size + 1
        return rows

    @property
    def input_rows(self) -> int:
        """Inputs of all entities; a bias on each entity's score follows them."""
        return sum(kind.count * kind.size for kind in self.kinds)


def attend(
    query: jax.Array, own: jax.Array, inputs: jax.Array, weights: jax.Array, layout: Layout
) -> jax.Array:
    """Weighted mean of entities for each head.

    Entity 0 is `own`; entity m is activation(W' x_m + b) with the weights of its kind. With score
    s_hm = scale * query_h . e_m + bias_m, the result of head h is sum_m softmax(s_h)_m e_m.

    Args:
        query: (B, heads * features), one query per head in the space of the embeddings.
        own: (B, features).
        inputs: (input_rows + entities, B) float32: all entities' numbers, then the biases (a large negative one masks).
        weights: (sum of size + 1 over kinds, features) float32: per kind its matrix, then its bias.
        layout: sizes.

    All but the biases in `inputs` are differentiable.

    Returns:
        (B, heads * features) in the type of `query`.
    """
    return _attend(query, own, inputs, weights, layout)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4,))
def _attend(query, own, inputs, weights, layout):
    return on_platform(_reference, _forward_kernel_call, layout)(query, own, inputs, weights)


def _attend_forward(query, own, inputs, weights, layout):
    return _attend(query, own, inputs, weights, layout), (query, own, inputs, weights)


def _attend_backward(layout, saved, gradient):
    return on_platform(_reference_backward, _backward_kernel_call, layout)(*saved, gradient)


_attend.defvjp(_attend_forward, _attend_backward)


def _reference(layout, query, own, inputs, weights):
    """The formula as it stands."""
    batch = own.shape[0]
    entities = [own.astype(jnp.float32)]
    for row, size, weight in layout.entities:
        linear = inputs[row : row + size].T @ weights[weight : weight + size] + weights[weight + size]
        entities.append(activation(linear))
    entities = jnp.stack(entities, axis=1)
    heads = query.reshape(batch, layout.heads, layout.features).astype(jnp.float32)
    score = layout.scale * jnp.einsum("bhf,bmf->bhm", heads, entities)
    bias = inputs[layout.input_rows :].T
    score = score + jnp.pad(bias, ((0, 0), (1, 0)))[:, None]
    mean = jnp.einsum("bhm,bmf->bhf", jax.nn.softmax(score, axis=-1), entities)
    return mean.reshape(batch, -1).astype(query.dtype)


def _reference_backward(layout, query, own, inputs, weights, gradient):
    _, pullback = jax.vjp(functools.partial(_reference, layout), query, own, inputs, weights)
    return pullback(gradient)


def _entity(layout, own, x, w_ref, m):
    """Entity m of a block of samples: (rows, F) float32, and its value before the activation (None for the pursuer)."""
    if m == 0:
        return own, None
    row, size, weight = layout.entities[m - 1]
    linear = w_ref[weight + size, :][None, :]
    for i in range(size):
        linear = linear + x(row + i)[:, None] * w_ref[weight + i, :][None, :]
    return activation(linear), linear


def _softmax(scores):
    """Softmax over a list of equally shaped arrays."""
    top = functools.reduce(jnp.maximum, scores)
    parts = [jnp.exp(s - top) for s in scores]
    total = functools.reduce(jnp.add, parts)
    return [p / total for p in parts]


def _forward_kernel(layout, q_ref, own_ref, x_ref, w_ref, out_ref):
    f, heads, number = layout.features, layout.heads, len(layout.entities) + 1
    own = own_ref[...].astype(jnp.float32)
    query = [q_ref[:, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale for h in range(heads)]

    def x(row):
        return x_ref[row, :]

    scores = [[] for _ in range(heads)]
    for m in range(number):
        entity, _ = _entity(layout, own, x, w_ref, m)
        for h in range(heads):
            score = jnp.sum(query[h] * entity, axis=1)
            scores[h].append(score if m == 0 else score + x(layout.input_rows + m - 1))
    weight = [_softmax(s) for s in scores]
    mean = [jnp.zeros_like(own) for _ in range(heads)]
    for m in range(number):
        entity, _ = _entity(layout, own, x, w_ref, m)
        for h in range(heads):
            mean[h] = mean[h] + weight[h][m][:, None] * entity
    for h in range(heads):
        out_ref[:, h * f : (h + 1) * f] = mean[h].astype(out_ref.dtype)


def _backward_kernel(layout, q_ref, own_ref, x_ref, w_ref, g_ref, dq_ref, down_ref, dlinear_ref):
    f, heads, number = layout.features, layout.heads, len(layout.entities) + 1
    own = own_ref[...].astype(jnp.float32)
    query = [q_ref[:, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale for h in range(heads)]
    gradient = [g_ref[:, h * f : (h + 1) * f].astype(jnp.float32) for h in range(heads)]

    def x(row):
        return x_ref[row, :]

    scores, dweights = [[] for _ in range(heads)], [[] for _ in range(heads)]
    for m in range(number):
        entity, _ = _entity(layout, own, x, w_ref, m)
        for h in range(heads):
            score = jnp.sum(query[h] * entity, axis=1)
            scores[h].append(score if m == 0 else score + x(layout.input_rows + m - 1))
            dweights[h].append(jnp.sum(gradient[h] * entity, axis=1))
    weight = [_softmax(s) for s in scores]
    dscore = []
    for h in range(heads):
        mean = functools.reduce(jnp.add, [w * d for w, d in zip(weight[h], dweights[h], strict=True)])
        dscore.append([w * (d - mean) for w, d in zip(weight[h], dweights[h], strict=True)])
    dquery = [jnp.zeros_like(own) for _ in range(heads)]
    for m in range(number):
        entity, linear = _entity(layout, own, x, w_ref, m)
        dentity = jnp.zeros_like(own)
        for h in range(heads):
            dentity = dentity + weight[h][m][:, None] * gradient[h] + dscore[h][m][:, None] * query[h]
            dquery[h] = dquery[h] + dscore[h][m][:, None] * entity
        if m == 0:
            down_ref[...] = dentity.astype(down_ref.dtype)
        else:
            dlinear_ref[m - 1, :, :] = (dentity * activation_slope(linear)).astype(dlinear_ref.dtype)
    for h in range(heads):
        dq_ref[:, h * f : (h + 1) * f] = (dquery[h] * layout.scale).astype(dq_ref.dtype)


def _block_specs(layout, inputs, weights):
    wide = pl.BlockSpec((ROWS, layout.heads * layout.features), lambda i: (i, 0))
    narrow = pl.BlockSpec((ROWS, layout.features), lambda i: (i, 0))
    numbers = pl.BlockSpec((inputs.shape[0], ROWS), lambda i: (0, i))
    whole = pl.BlockSpec(weights.shape, lambda i: (0, 0))
    return wide, narrow, numbers, whole


def _forward_kernel_call(layout, query, own, inputs, weights, interpret=False):
    batch = own.shape[0]
    query, own = whole_blocks(query, ROWS), whole_blocks(own, ROWS)
    inputs = whole_blocks(inputs, ROWS, axis=1)
    wide, narrow, numbers, whole = _block_specs(layout, inputs, weights)
    mean = pl.pallas_call(
        functools.partial(_forward_kernel, layout),
        out_shape=jax.ShapeDtypeStruct(query.shape, query.dtype),
        grid=(own.shape[0] // ROWS,),
        in_specs=[wide, narrow, numbers, whole],
        out_specs=wide,
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="attend",
    )(query, own, inputs, weights)
    return mean[:batch]


def _backward_kernel_call(layout, query, own, inputs, weights, gradient, interpret=False):
    batch = own.shape[0]
    query, own, gradient = (whole_blocks(samples, ROWS) for samples in (query, own, gradient))
    inputs = whole_blocks(inputs, ROWS, axis=1)
    wide, narrow, numbers, whole = _block_specs(layout, inputs, weights)
    number = len(layout.entities)
    dquery, down, dlinear = pl.pallas_call(
        functools.partial(_backward_kernel, layout),
        out_shape=(
            jax.ShapeDtypeStruct(query.shape, query.dtype),
            jax.ShapeDtypeStruct(own.shape, own.dtype),
            jax.ShapeDtypeStruct((number, *own.shape), own.dtype),
        ),
        grid=(own.shape[0] // ROWS,),
        in_specs=[wide, narrow, numbers, whole, wide],
        out_specs=(wide, narrow, pl.BlockSpec((number, ROWS, layout.features), lambda i: (0, i, 0))),
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="attend_backward",
    )(query, own, inputs, weights, gradient)
    # what is left are products over the batch, with the inputs and with the weights of each kind
    weight_grads, input_grads, start, first = [], [], 0, 0
    for kind in layout.kinds:
        size, part = kind.size, dlinear[start : start + kind.count]
        row = layout.entities[start][0]
        x = inputs[row : row + kind.count * size].reshape(kind.count, size, -1)
        # the bias is one more input that is always one
        x = jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1).astype(part.dtype)
        weight_grads.append(jnp.einsum("mib,mbf->if", x, part, preferred_element_type=jnp.float32))
        kernel = weights[first : first + size].astype(part.dtype)
        input_grads.append(
            jnp.einsum("mbf,if->mib", part, kernel, preferred_element_type=jnp.float32).reshape(
                -1, part.shape[1]
            )
        )
        start, first = start + kind.count, first + size + 1
    # the scores' biases mask, they are not learnt
    input_grads.append(jnp.zeros((number, inputs.shape[1]), inputs.dtype))
    return (
        dquery[:batch],
        down[:batch],
        jnp.concatenate(input_grads)[:, :batch],
        jnp.concatenate(weight_grads),
    )
