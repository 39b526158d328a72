"""Attention of one query per sample over a few entities that are embedded on the fly.

Entities other than the pursuer itself are described by a few numbers each, so their
embeddings, a linear layer and an activation, cost less to compute again than to read
back. On a GPU a hand-written kernel (Pallas, Triton) therefore embeds them in
registers, forward and backward, and nothing as large as samples x entities x features
reaches memory: XLA's own fusions moved several times as many bytes. Elsewhere the same
formula is left to XLA.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.activation import (
    activation,
    activation_and_slope,
    kernel_arithmetic,
)
from openjax.platform import on_platform, whole_blocks

ROWS = 8
"""Samples that one program of the kernel works on at a time: with more, the backward
kernel's registers spill.
"""

BLOCK = 64
"""Samples of one program of the backward kernel, which adds up their gradients of the
weights.
"""

FORWARD_WARPS = 4
BACKWARD_WARPS = 8
"""Groups of 32 threads of a program; the backward one holds twice as much in its
registers.
"""


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
        """(row of the first input, size, row of the first weight) of every entity but
        the pursuer itself.
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


class Operands(NamedTuple):
    """What attends to what, for B samples; all but `inputs` are differentiable."""

    query: jax.Array
    """(B, heads * features), one query per head in the space of the embeddings"""
    token: jax.Array
    """(B, features), the pursuer itself"""
    inputs: jax.Array
    """(input_rows + entities, B) float32: all entities' numbers, then the biases (a
    large negative one masks); samples last, so that a kernel reads neighbours' numbers
    in one go
    """
    inverse: jax.Array
    """(entities, B) float32, by which the linear layer's output is scaled"""
    weights: jax.Array
    """(sum of size + 2 over kinds, features) float32: per kind its matrix W, then b and
    c
    """


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
        products = [
            (part * inverse) * e for part, e in zip(parts, entities, strict=True)
        ]
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
            inputs[row : row + size].T @ weights[weight : weight + size]
            + weights[weight + size]
        )
        entities.append(
            activation(inverse[m][:, None] * linear + weights[weight + size + 1])
        )
    entities = jnp.stack(entities, axis=1)
    heads = query.reshape(batch, layout.heads, layout.features).astype(jnp.float32)
    score = layout.scale * jnp.einsum("bhf,bmf->bhm", heads, entities)
    bias = inputs[layout.input_rows :].T
    score = score + jnp.pad(bias, ((0, 0), (1, 0)))[:, None]
    mean = jnp.einsum("bhm,bmf->bhf", jax.nn.softmax(score, axis=-1), entities)
    return mean.reshape(batch, -1).astype(query.dtype)


def _reference_backward(layout, operands, gradient):
    def of_differentiable(query, token, inverse, weights):
        return _reference(
            layout, Operands(query, token, operands.inputs, inverse, weights)
        )

    query, token, _, inverse, weights = operands
    _, pullback = jax.vjp(of_differentiable, query, token, inverse, weights)
    return pullback(gradient)


class _Entities(NamedTuple):
    """The entities of a block of samples, as a kernel embeds them."""

    layout: Layout
    add: Callable
    """(a, b, c) -> a * b + c"""
    x: Callable
    """(row) -> (rows,) one of the entities' numbers, or biases"""
    inverse: Callable
    """(m) -> (rows,)"""
    w_ref: jax.Array

    def linear(self, m):
        """W' x + b of entity m + 1, (rows, F) float32, and that times inverse + c."""
        row, size, weight = self.layout.entities[m]
        linear = self.w_ref[weight + size, :][None, :]
        for i in range(size):
            linear = self.add(
                self.x(row + i)[:, None], self.w_ref[weight + i, :][None, :], linear
            )
        shift = self.w_ref[weight + size + 1, :][None, :]
        return linear, self.add(self.inverse(m)[:, None], linear, shift)

    def scores(self, query, entities):
        """Of one head's queries (rows, F) with all embedded entities, (rows,) each."""
        scores = [jnp.sum(query * entity, axis=1) for entity in entities]
        # the pursuer itself, the first one, is always there and has no bias
        biases = [self.x(self.layout.input_rows + m) for m in range(len(entities) - 1)]
        return [
            scores[0],
            *(score + bias for score, bias in zip(scores[1:], biases, strict=True)),
        ]


def _softmax(scores):
    """Softmax over a list of equally shaped arrays."""
    # less the largest, or an exponential of a large score would be infinite
    top = functools.reduce(jnp.maximum, scores)
    parts = [jnp.exp(s - top) for s in scores]
    total = functools.reduce(jnp.add, parts)
    return [p / total for p in parts]


def _forward_kernel(
    layout, arithmetic, q_ref, token_ref, x_ref, inverse_ref, w_ref, out_ref
):
    f = layout.features
    add = arithmetic.multiply_add
    entities = _Entities(
        layout, add, lambda row: x_ref[row, :], lambda m: inverse_ref[m, :], w_ref
    )
    entities_in_rows = [token_ref[...].astype(jnp.float32)]
    for m in range(len(layout.entities)):
        _, normal = entities.linear(m)
        entities_in_rows.append(activation(normal, arithmetic))
    for h in range(layout.heads):
        query = q_ref[:, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale
        weights = _softmax(entities.scores(query, entities_in_rows))
        mean = jnp.zeros_like(query)
        for weight, entity in zip(weights, entities_in_rows, strict=True):
            mean = add(weight[:, None], entity, mean)
        out_ref[:, h * f : (h + 1) * f] = mean.astype(out_ref.dtype)


def _backward_kernel(
    layout,
    arithmetic,
    q_ref,
    token_ref,
    x_ref,
    inverse_ref,
    w_ref,
    g_ref,
    dq_ref,
    dtoken_ref,
    dinverse_ref,
    dw_ref,
):
    f = layout.features
    add = arithmetic.multiply_add

    def block(j, sums):
        rows = pl.ds(j * ROWS, ROWS)
        entities = _Entities(
            layout,
            add,
            lambda row: x_ref[row, rows],
            lambda m: inverse_ref[m, rows],
            w_ref,
        )
        # forward once more: to embed them again costs less than to have kept them
        entities_in_rows = [token_ref[rows, :].astype(jnp.float32)]
        slopes = []
        linears = []
        for m in range(len(layout.entities)):
            linear, normal = entities.linear(m)
            entity, slope = activation_and_slope(normal, arithmetic)
            entities_in_rows.append(entity)
            slopes.append(slope)
            linears.append(linear)
        dentities = [jnp.zeros_like(entities_in_rows[0]) for _ in entities_in_rows]
        for h in range(layout.heads):
            query = q_ref[rows, h * f : (h + 1) * f].astype(jnp.float32) * layout.scale
            gradient = g_ref[rows, h * f : (h + 1) * f].astype(jnp.float32)
            weight = _softmax(entities.scores(query, entities_in_rows))
            dweight = [
                jnp.sum(gradient * entity, axis=1) for entity in entities_in_rows
            ]
            # the softmax's own derivative: w_m (d_m - sum w d)
            mean = functools.reduce(
                jnp.add, [w * d for w, d in zip(weight, dweight, strict=True)]
            )
            dquery = jnp.zeros_like(query)
            for m, entity in enumerate(entities_in_rows):
                dscore = (weight[m] * (dweight[m] - mean))[:, None]
                dquery = add(dscore, entity, dquery)
                dentities[m] = add(
                    weight[m][:, None], gradient, add(dscore, query, dentities[m])
                )
            dq_ref[rows, h * f : (h + 1) * f] = (dquery * layout.scale).astype(
                dq_ref.dtype
            )
        dtoken_ref[rows, :] = dentities[0].astype(dtoken_ref.dtype)
        # of the weights a row each, summed over samples only when all blocks are done
        sums = list(sums)
        for m, (row, size, weight) in enumerate(layout.entities):
            dnormal = dentities[m + 1] * slopes[m]
            dinverse_ref[m, rows] = jnp.sum(dnormal * linears[m], axis=1)
            dlinear = dnormal * entities.inverse(m)[:, None]
            for i in range(size):
                sums[weight + i] = add(
                    dlinear, entities.x(row + i)[:, None], sums[weight + i]
                )
            sums[weight + size] = sums[weight + size] + dlinear
            sums[weight + size + 1] = sums[weight + size + 1] + dnormal
        return tuple(sums)

    start = tuple(jnp.zeros((ROWS, f), jnp.float32) for _ in range(dw_ref.shape[1]))
    for i, total in enumerate(jax.lax.fori_loop(0, BLOCK // ROWS, block, start)):
        dw_ref[0, i, :] = jnp.sum(total, axis=0)


def _in_blocks(operands, rows):
    """The operands filled up to whole blocks of samples, and the specifications of
    these blocks: (B, n) by rows, (n, B) by columns, all weights in each.
    """
    operands = Operands(
        query=whole_blocks(operands.query, rows),
        token=whole_blocks(operands.token, rows),
        inputs=whole_blocks(operands.inputs, rows, axis=1),
        inverse=whole_blocks(operands.inverse, rows, axis=1),
        weights=operands.weights,
    )

    def by_rows(array):
        return pl.BlockSpec((rows, array.shape[1]), lambda i: (i, 0))

    def by_columns(array):
        return pl.BlockSpec((array.shape[0], rows), lambda i: (0, i))

    specs = Operands(
        query=by_rows(operands.query),
        token=by_rows(operands.token),
        inputs=by_columns(operands.inputs),
        inverse=by_columns(operands.inverse),
        weights=pl.BlockSpec(operands.weights.shape, lambda i: (0, 0)),
    )
    return operands, specs


def forward_by_kernel(layout, operands, interpret=False):
    """What the reference gives, by a kernel; `interpret` runs it without a GPU."""
    batch = operands.token.shape[0]
    operands, specs = _in_blocks(operands, ROWS)
    query = operands.query
    mean = pl.pallas_call(
        functools.partial(
            _forward_kernel, layout, kernel_arithmetic(query.dtype, interpret)
        ),
        out_shape=jax.ShapeDtypeStruct(query.shape, query.dtype),
        grid=(query.shape[0] // ROWS,),
        in_specs=list(specs),
        out_specs=specs.query,
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(
            num_warps=FORWARD_WARPS, num_stages=1
        ),
        name="attend",
    )(*operands)
    return mean[:batch]


def backward_by_kernel(layout, operands, gradient, interpret=False):
    """The reference's gradients of query, token, inverse and weights, by a kernel;
    `interpret` runs it without a GPU.
    """
    batch = operands.token.shape[0]
    operands, specs = _in_blocks(operands, BLOCK)
    # samples that only fill the last block have no gradient, so they add nothing to the
    # sums
    gradient = whole_blocks(gradient, BLOCK)
    query, token, _, inverse, weights = operands
    programs = token.shape[0] // BLOCK
    dquery, dtoken, dinverse, parts = pl.pallas_call(
        functools.partial(
            _backward_kernel, layout, kernel_arithmetic(query.dtype, interpret)
        ),
        out_shape=(
            jax.ShapeDtypeStruct(query.shape, query.dtype),
            jax.ShapeDtypeStruct(token.shape, token.dtype),
            jax.ShapeDtypeStruct(inverse.shape, inverse.dtype),
            jax.ShapeDtypeStruct((programs, *weights.shape), jnp.float32),
        ),
        grid=(programs,),
        in_specs=[*specs, specs.query],
        out_specs=(
            specs.query,
            specs.token,
            specs.inverse,
            # each program's own sums, added up below: programs can't add to one place
            pl.BlockSpec((1, *weights.shape), lambda i: (i, 0, 0)),
        ),
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(
            num_warps=BACKWARD_WARPS, num_stages=1
        ),
        name="attend_backward",
    )(*operands, gradient)
    return dquery[:batch], dtoken[:batch], dinverse[:, :batch], jnp.sum(parts, axis=0)
