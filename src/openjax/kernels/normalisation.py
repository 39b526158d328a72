"""Bias, layer normalisation and activation of a hidden layer in one pass over its
samples.

Left to XLA, the backward pass reads every layer several times (once for each of the
sums over features and over samples); on a GPU a kernel (Pallas, Triton) holds a block
of samples in registers and reads it once. Elsewhere the same formula is left to XLA.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.activation import activation, activation_and_slope, kernel_arithmetic
from openjax.platform import on_platform, whole_blocks

ROWS = 64
"""Samples that one program of the kernel works on."""

WARPS = 4
"""Groups of 32 threads of a program."""

EPSILON = 1e-6
"""Added to the variance (Ba et al., 2016; the value of flax)."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def normalise(x: jax.Array, affine: jax.Array, activate: bool = True) -> jax.Array:
    """activation(scale * LayerNorm(x + bias) + shift), or without the activation.

    Args:
      x: (B, features); the arithmetic is float32 whatever its type.
      affine: (3, features) float32, the rows bias, scale, shift.
      activate: apply the activation.

    Returns:
      (B, features) in the type of `x`.
    """
    return on_platform(_reference, forward_by_kernel, activate)(x, affine)


def normalised_layer(x: jax.Array, kernel: jax.Array, affine: jax.Array) -> jax.Array:
    """`normalise(x @ kernel, affine)` with centred weights, whose output needs no
    centring: half the sums, forward and backward.

    Args:
      x: (B, inputs), whose type is that of the product.
      kernel: (inputs, features) float32.
      affine: (3, features) float32, the rows bias, scale, shift.

    Returns:
      (B, features) in the type of `x`.
    """
    # centring is linear: done once to the weights, it is done to all samples
    kernel = kernel - jnp.mean(kernel, axis=-1, keepdims=True)
    bias = affine[0] - jnp.mean(affine[0])
    y = (x @ kernel.astype(x.dtype)).astype(jnp.float32) + bias
    inverse = jax.lax.rsqrt(jnp.mean(y * y, axis=-1, keepdims=True) + EPSILON)
    return activation(affine[1] * (y * inverse) + affine[2]).astype(x.dtype)


def _forward(x, affine, activate):
    return normalise(x, affine, activate), (x, affine)


def _backward(activate, residuals, gradient):
    return on_platform(_reference_backward, backward_by_kernel, activate)(*residuals, gradient)


normalise.defvjp(_forward, _backward)


def _standardise(x, bias):
    """(x + bias) with mean 0 and variance 1 over the features, and the inverse standard
    deviation.
    """
    x = x.astype(jnp.float32) + bias
    features = x.shape[-1]
    deviation = x - jnp.sum(x, axis=-1, keepdims=True) / features
    inverse = jax.lax.rsqrt(
        jnp.sum(deviation * deviation, axis=-1, keepdims=True) / features + EPSILON
    )
    return deviation * inverse, inverse


def _reference(activate, x, affine):
    """The formula as it stands."""
    standard, _ = _standardise(x, affine[0])
    out = affine[1] * standard + affine[2]
    return (activation(out) if activate else out).astype(x.dtype)


def _reference_backward(activate, x, affine, gradient):
    _, pullback = jax.vjp(functools.partial(_reference, activate), x, affine)
    return pullback(gradient)


def _forward_kernel(activate, arithmetic, x_ref, affine_ref, out_ref):
    standard, _ = _standardise(x_ref[...], affine_ref[0, :][None, :])
    out = arithmetic.multiply_add(standard, affine_ref[1, :][None, :], affine_ref[2, :][None, :])
    out_ref[...] = (activation(out, arithmetic) if activate else out).astype(out_ref.dtype)


def _backward_kernel(activate, arithmetic, x_ref, affine_ref, g_ref, dx_ref, daffine_ref):
    standard, inverse = _standardise(x_ref[...], affine_ref[0, :][None, :])
    scale = affine_ref[1, :][None, :]
    dout = g_ref[...].astype(jnp.float32)
    if activate:
        out = arithmetic.multiply_add(standard, scale, affine_ref[2, :][None, :])
        dout = dout * activation_and_slope(out, arithmetic)[1]
    dstandard = dout * scale
    # layer normalisation lets nothing through along its two directions, the mean and
    # the output
    features = standard.shape[-1]
    mean = jnp.sum(dstandard, axis=-1, keepdims=True) / features
    along = jnp.sum(dstandard * standard, axis=-1, keepdims=True) / features
    dx = inverse * arithmetic.multiply_add(standard, -along, dstandard - mean)
    dx_ref[...] = dx.astype(dx_ref.dtype)
    daffine_ref[0, 0, :] = jnp.sum(dx, axis=0)
    daffine_ref[0, 1, :] = jnp.sum(dout * standard, axis=0)
    daffine_ref[0, 2, :] = jnp.sum(dout, axis=0)


def forward_by_kernel(activate, x, affine, interpret=False):
    """The reference's result, by a kernel; `interpret` runs it without a GPU."""
    blocks = whole_blocks(x, ROWS)
    block = pl.BlockSpec((ROWS, x.shape[1]), lambda i: (i, 0))
    out = pl.pallas_call(
        functools.partial(_forward_kernel, activate, kernel_arithmetic(x.dtype, interpret)),
        out_shape=jax.ShapeDtypeStruct(blocks.shape, blocks.dtype),
        grid=(blocks.shape[0] // ROWS,),
        in_specs=[block, pl.BlockSpec(affine.shape, lambda i: (0, 0))],
        out_specs=block,
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="normalise",
    )(blocks, affine)
    return out[: x.shape[0]]


def backward_by_kernel(activate, x, affine, gradient, interpret=False):
    """The reference's gradients, by a kernel; `interpret` runs it without a GPU."""
    # samples that only fill the last block have no gradient, so they add nothing to the
    # sums
    blocks = whole_blocks(x, ROWS)
    padded_gradient = whole_blocks(gradient, ROWS)
    programs = blocks.shape[0] // ROWS
    features = x.shape[1]
    block = pl.BlockSpec((ROWS, features), lambda i: (i, 0))
    dx, parts = pl.pallas_call(
        functools.partial(_backward_kernel, activate, kernel_arithmetic(x.dtype, interpret)),
        out_shape=(
            jax.ShapeDtypeStruct(blocks.shape, blocks.dtype),
            jax.ShapeDtypeStruct((programs, 3, features), jnp.float32),
        ),
        grid=(programs,),
        in_specs=[block, pl.BlockSpec(affine.shape, lambda i: (0, 0)), block],
        out_specs=(block, pl.BlockSpec((1, 3, features), lambda i: (i, 0, 0))),
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="normalise_backward",
    )(blocks, affine, padded_gradient)
    return dx[: x.shape[0]], jnp.sum(parts, axis=0)
