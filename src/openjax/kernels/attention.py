"""Attention of one query per sample over a few entities that are embedded on the fly.

Entities other than the pursuer itself are described by a few numbers each, so their embeddings, a
linear layer and an activation, cost less to compute again than to read back. On a GPU a
hand-written kernel (Pallas, Triton) therefore embeds them in registers, forward and backward, and
nothing as large as samples x entities x features reaches memory: XLA's own fusions moved several
times as many bytes. Elsewhere the same formula is left to XLA.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.activation import activation, activation_and_slope, kernel_arithmetic
from openjax.platform import on_platform, whole_blocks

ROWS = 8
"""Samples that one program of the kernel works on at a time: with more, the backward kernel's
registers spill.
"""

BLOCK = 64
"""Samples of one program of the backward kernel, which adds up their gradients of the weights."""

FORWARD_WARPS = 4
BACKWARD_WARPS = 8


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
        """(row of the first input, size, row of the first weight) of every entity but the pursuer
        itself.
        """
        rows = []
        row = 0
        weight = 0
        for kind in self.kinds:
            for _ in range(kind.count):
                rows.append((row, kind.size, weight))
                row += kind.size
            weight += kind.size + 2
        return rows

    @property
    def input_rows(self) -> int:
        """Numbers of all entities; a bias on each entity's score follows them."""
        return sum(kind.count * kind.size for kind in self.kinds)


@functools.partial(jax.custom_vjp, nondiff_argnums=(5,))
def attend(
    query: jax.Array,
    own: jax.Array,
    inputs: jax.Array,
    inverse: jax.Array,
    weights: jax.Array,
    layout: Layout,
) -> jax.Array:
    """Weighted mean of entities for each head.

    Entity 0 is `own`; entity m is activation(inverse_m (W' x_m + b) + c) with the weights of its
    kind. With score s_hm = scale * query_h . e_m + bias_m, the result of head h is sum_m
    softmax(s_h)_m e_m.

    Args:
      query: (B, heads * features), one query per head in the space of the embeddings.
      own: (B, features).
      inputs: (input_rows + entities, B) float32: all entities' numbers, then the biases (a large
      negative one masks).
      inverse: (entities, B) float32, by which the linear layer's output is scaled.
      weights: (sum of size + 2 over kinds, features) float32: per kind its matrix W, then b and c.
      layout: sizes.

    All but `inputs` are differentiable.

    Returns:
      (B, heads * features) in the type of `query`.
    """
    return on_platform(_reference, forward_by_kernel, layout)(query, own, inputs, inverse, weights)


def attend_one_by_one(
    queries: list[jax.Array], entities: list[jax.Array], biases: list[jax.Array | float]
) -> list[jax.Array]:
    """The same mean from arrays of their own for every head and entity, as XLA's CPU compiler wants
    them.

    Batches of tiny products are loops without vector instructions there, and so is whatever is
    fused with a slice or a concatenation of entities; sums over features and (B, features) arrays
    alone run at full width.

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
        top = jax.lax.stop_gradient(functools.reduce(jnp.maximum, scores))
        parts = [jnp.exp(score - top) for score in scores]
        inverse = 1.0 / functools.reduce(jnp.add, parts)
        weighted = [(part * inverse) * e for part, e in zip(parts, entities, strict=True)]
        means.append(functools.reduce(jnp.add, weighted))
    return means


def _attend_forward(query, own, inputs, inverse, weights, layout):
    saved = (query, own, inputs, inverse, weights)
    return attend(*saved, layout), saved


def _attend_backward(layout, saved, gradient):
    dquery, down, dinverse, dweights = on_platform(_reference_backward, backward_by_kernel, layout)(
        *saved, gradient
    )
    return dquery, down, jnp.zeros_like(saved[2]), dinverse, dweights


attend.defvjp(_attend_forward, _attend_backward)


def _reference(layout, query, own, inputs, inverse, weights):
    """The formula as it stands."""
    batch = own.shape[0]
    entities = [own.astype(jnp.float32)]
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


def _reference_backward(layout, query, own, inputs, inverse, weights, gradient):
    def of_differentiable(query, own, inverse, weights):
        return _reference(layout, query, own, inputs, inverse, weights)

    _, pullback = jax.vjp(of_differentiable, query, own, inverse, weights)
    return pullback(gradient)


def _linear(layout, add, x, inverse, w_ref, m):
    """W' x + b of entity m + 1 for a block of samples, (rows, F) float32, and that times inverse +
    c.
    """
    row, size, weight = layout.entities[m]
    linear = w_ref[weight + size, :][None, :]
    for i in range(size):
        linear = add(x(row + i)[:, None], w_ref[weight + i, :][None, :], linear)
    return linear, add(inverse(m)[:, None], linear, w_ref[weight + size + 1, :][None, :])


def _softmax(scores):
    """Softmax over a list of equally shaped arrays."""
    top = functools.reduce(jnp.maximum, scores)
    parts = [jnp.exp(s - top) for s in scores]
    total = functools.reduce(jnp.add, parts)
    return [p / total for p in parts]


def _forward_kernel(layout, arithmetic, q_ref, own_ref, x_ref, inverse_ref, w_ref, out_ref):
    f = layout.features
    heads = layout.heads
    number = len(layout.entities)
    add = arithmetic.multiply_add

    def x(row):
        return x_ref[row, :]

    def inverse(m):
        return inverse_ref[m, :]

    linear = (_linear(layout, add, x, inverse, w_ref, m)[1] for m in range(number))
    entities = [
        own_ref[...].astype(jnp.float32),
        *(activation(entity, arithmetic) for entity in linear),
    ]
    for h in range(heads):
        query = q_ref[:, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale
        scores = [jnp.sum(query * entity, axis=1) for entity in entities]
        scores = [scores[0], *(scores[m + 1] + x(layout.input_rows + m) for m in range(number))]
        mean = jnp.zeros_like(query)
        for weight, entity in zip(_softmax(scores), entities, strict=True):
            mean = add(weight[:, None], entity, mean)
        out_ref[:, h * f : (h + 1) * f] = mean.astype(out_ref.dtype)


def _backward_kernel(
    layout,
    arithmetic,
    q_ref,
    own_ref,
    x_ref,
    inverse_ref,
    w_ref,
    g_ref,
    dq_ref,
    down_ref,
    dinverse_ref,
    dw_ref,
):
    f = layout.features
    heads = layout.heads
    number = len(layout.entities)
    add = arithmetic.multiply_add

    def block(j, sums):
        rows = pl.ds(j * ROWS, ROWS)

        def x(row):
            return x_ref[row, rows]

        def inverse(m):
            return inverse_ref[m, rows]

        entities = [own_ref[rows, :].astype(jnp.float32)]
        slopes = []
        linears = []
        for m in range(number):
            linear, normal = _linear(layout, add, x, inverse, w_ref, m)
            entity, slope = activation_and_slope(normal, arithmetic)
            entities.append(entity)
            slopes.append(slope)
            linears.append(linear)
        dentities = [jnp.zeros_like(entities[0]) for _ in entities]
        for h in range(heads):
            query = q_ref[rows, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale
            gradient = g_ref[rows, h * f : (h + 1) * f].astype(jnp.float32)
            scores = [jnp.sum(query * entity, axis=1) for entity in entities]
            scores = [scores[0], *(scores[m + 1] + x(layout.input_rows + m) for m in range(number))]
            weight = _softmax(scores)
            dweight = [jnp.sum(gradient * entity, axis=1) for entity in entities]
            mean = functools.reduce(jnp.add, [w * d for w, d in zip(weight, dweight, strict=True)])
            dquery = jnp.zeros_like(query)
            for m, entity in enumerate(entities):
                dscore = (weight[m] * (dweight[m] - mean))[:, None]
                dquery = add(dscore, entity, dquery)
                dentities[m] = add(weight[m][:, None], gradient, add(dscore, query, dentities[m]))
            dq_ref[rows, h * f : (h + 1) * f] = (dquery * layout.scale).astype(dq_ref.dtype)
        down_ref[rows, :] = dentities[0].astype(down_ref.dtype)
        sums = list(sums)
        for m, (row, size, weight) in enumerate(layout.entities):
            dnormal = dentities[m + 1] * slopes[m]
            dinverse_ref[m, rows] = jnp.sum(dnormal * linears[m], axis=1)
            dlinear = dnormal * inverse(m)[:, None]
            for i in range(size):
                sums[weight + i] = add(dlinear, x(row + i)[:, None], sums[weight + i])
            sums[weight + size] = sums[weight + size] + dlinear
            sums[weight + size + 1] = sums[weight + size + 1] + dnormal
        return tuple(sums)

    start = tuple(jnp.zeros((ROWS, f), jnp.float32) for _ in range(dw_ref.shape[1]))
    for i, total in enumerate(jax.lax.fori_loop(0, BLOCK // ROWS, block, start)):
        dw_ref[0, i, :] = jnp.sum(total, axis=0)


def _block_specs(layout, rows, *arrays):
    """Specifications of arrays in blocks of samples: (B, n) by rows, (n, B) by columns."""
    return [
        pl.BlockSpec((rows, array.shape[1]), lambda i: (i, 0))
        if by_rows
        else pl.BlockSpec((array.shape[0], rows), lambda i: (0, i))
        for array, by_rows in arrays
    ]


def forward_by_kernel(layout, query, own, inputs, inverse, weights, interpret=False):
    """What the reference gives, by a kernel; `interpret` runs it without a GPU."""
    batch = own.shape[0]
    query = whole_blocks(query, ROWS)
    own = whole_blocks(own, ROWS)
    inputs = whole_blocks(inputs, ROWS, axis=1)
    inverse = whole_blocks(inverse, ROWS, axis=1)
    specs = _block_specs(
        layout, ROWS, (query, True), (own, True), (inputs, False), (inverse, False)
    )
    mean = pl.pallas_call(
        functools.partial(_forward_kernel, layout, kernel_arithmetic(query.dtype, interpret)),
        out_shape=jax.ShapeDtypeStruct(query.shape, query.dtype),
        grid=(own.shape[0] // ROWS,),
        in_specs=[*specs, pl.BlockSpec(weights.shape, lambda i: (0, 0))],
        out_specs=specs[0],
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=FORWARD_WARPS, num_stages=1),
        name="attend",
    )(query, own, inputs, inverse, weights)
    return mean[:batch]


def backward_by_kernel(layout, query, own, inputs, inverse, weights, gradient, interpret=False):
    """The reference\'s gradients, by a kernel; `interpret` runs it without a GPU."""
    batch = own.shape[0]
    # samples that only fill the last block have no gradient, so they add nothing to the sums
    query, own, gradient = (whole_blocks(samples, BLOCK) for samples in (query, own, gradient))
    inputs = whole_blocks(inputs, BLOCK, axis=1)
    inverse = whole_blocks(inverse, BLOCK, axis=1)
    wide, narrow, numbers, scales = _block_specs(
        layout, BLOCK, (query, True), (own, True), (inputs, False), (inverse, False)
    )
    programs = own.shape[0] // BLOCK
    dquery, down, dinverse, parts = pl.pallas_call(
        functools.partial(_backward_kernel, layout, kernel_arithmetic(query.dtype, interpret)),
        out_shape=(
            jax.ShapeDtypeStruct(query.shape, query.dtype),
            jax.ShapeDtypeStruct(own.shape, own.dtype),
            jax.ShapeDtypeStruct(inverse.shape, inverse.dtype),
            jax.ShapeDtypeStruct((programs, *weights.shape), jnp.float32),
        ),
        grid=(programs,),
        in_specs=[
            wide,
            narrow,
            numbers,
            scales,
            pl.BlockSpec(weights.shape, lambda i: (0, 0)),
            wide,
        ],
        out_specs=(wide, narrow, scales, pl.BlockSpec((1, *weights.shape), lambda i: (i, 0, 0))),
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=BACKWARD_WARPS, num_stages=1),
        name="attend_backward",
    )(query, own, inputs, inverse, weights, gradient)
    return dquery[:batch], down[:batch], dinverse[:, :batch], jnp.sum(parts, axis=0)
