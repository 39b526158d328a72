"""The attention as a hand-written kernel (Pallas, Triton), forward and backward:
entities are embedded in registers. Its formula stands in `attention`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.activation import activation, activation_and_slope, kernel_arithmetic
from openjax.kernels.attention_operands import Layout, Operands
from openjax.platform import whole_blocks

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
            linear = self.add(self.x(row + i)[:, None], self.w_ref[weight + i, :][None, :], linear)
        shift = self.w_ref[weight + size + 1, :][None, :]
        return linear, self.add(self.inverse(m)[:, None], linear, shift)

    def scores(self, query, entities):
        """Of one head's queries (rows, F) with all embedded entities, (rows,) each."""
        scores = [jnp.sum(query * entity, axis=1) for entity in entities]
        # the pursuer itself, the first one, is always there and has no bias
        biases = [self.x(self.layout.input_rows + m) for m in range(len(entities) - 1)]
        return [scores[0], *(score + bias for score, bias in zip(scores[1:], biases, strict=True))]


def _softmax(scores):
    """Softmax over a list of equally shaped arrays."""
    # less the largest, or an exponential of a large score would be infinite
    top = functools.reduce(jnp.maximum, scores)
    parts = [jnp.exp(s - top) for s in scores]
    total = functools.reduce(jnp.add, parts)
    return [p / total for p in parts]


def _forward_kernel(layout, arithmetic, q_ref, token_ref, x_ref, inverse_ref, w_ref, out_ref):
    f = layout.features
    add = arithmetic.multiply_add
    entities = _Entities(layout, add, lambda row: x_ref[row, :], lambda m: inverse_ref[m, :], w_ref)
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
            layout, add, lambda row: x_ref[row, rows], lambda m: inverse_ref[m, rows], w_ref
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
            dweight = [jnp.sum(gradient * entity, axis=1) for entity in entities_in_rows]
            # the softmax's own derivative: w_m (d_m - sum w d)
            mean = functools.reduce(jnp.add, [w * d for w, d in zip(weight, dweight, strict=True)])
            dquery = jnp.zeros_like(query)
            for m, entity in enumerate(entities_in_rows):
                dscore = (weight[m] * (dweight[m] - mean))[:, None]
                dquery = add(dscore, entity, dquery)
                dentities[m] = add(weight[m][:, None], gradient, add(dscore, query, dentities[m]))
            dq_ref[rows, h * f : (h + 1) * f] = (dquery * layout.scale).astype(dq_ref.dtype)
        dtoken_ref[rows, :] = dentities[0].astype(dtoken_ref.dtype)
        # of the weights a row each, summed over samples only when all blocks are done
        sums = list(sums)
        for m, (row, size, weight) in enumerate(layout.entities):
            dnormal = dentities[m + 1] * slopes[m]
            dinverse_ref[m, rows] = jnp.sum(dnormal * linears[m], axis=1)
            dlinear = dnormal * entities.inverse(m)[:, None]
            for i in range(size):
                sums[weight + i] = add(dlinear, entities.x(row + i)[:, None], sums[weight + i])
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
    """The reference's result, by a kernel; `interpret` runs it without a GPU."""
    batch = operands.token.shape[0]
    operands, specs = _in_blocks(operands, ROWS)
    query = operands.query
    mean = pl.pallas_call(
        functools.partial(_forward_kernel, layout, kernel_arithmetic(query.dtype, interpret)),
        out_shape=jax.ShapeDtypeStruct(query.shape, query.dtype),
        grid=(query.shape[0] // ROWS,),
        in_specs=list(specs),
        out_specs=specs.query,
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=FORWARD_WARPS, num_stages=1),
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
        functools.partial(_backward_kernel, layout, kernel_arithmetic(query.dtype, interpret)),
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
        compiler_params=pallas_triton.CompilerParams(num_warps=BACKWARD_WARPS, num_stages=1),
        name="attend_backward",
    )(*operands, gradient)
    return dquery[:batch], dtoken[:batch], dinverse[:, :batch], jnp.sum(parts, axis=0)
