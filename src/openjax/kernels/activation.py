"""The networks' activation as a formula that XLA and the kernels share, and the
arithmetic that kernels do it with.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.pallas import triton as pallas_triton


class Arithmetic(NamedTuple):
    """The operations by which a kernel uses a GPU's own instructions."""

    tanh: Callable
    multiply_add: Callable
    """(a, b, c) -> a * b + c, shapes alike but for broadcasting."""


PLAIN = Arithmetic(jnp.tanh, lambda a, b, c: a * b + c)


def kernel_arithmetic(dtype: jnp.dtype, interpret: bool) -> Arithmetic:
    """The arithmetic of a kernel whose results are stored as `dtype`.

    The GPU's own tanh errs by less than a bfloat16 can show. Triton's compiler leaves
    products and sums apart unless told.
    """
    if interpret:
        return PLAIN
    tanh = pallas_triton.approx_tanh if dtype == jnp.bfloat16 else jnp.tanh
    return Arithmetic(tanh, _multiply_add)


def _multiply_add(a, b, c):
    shape = jnp.broadcast_shapes(a.shape, b.shape, c.shape)
    return pallas_triton.elementwise_inline_asm(
        "fma.rn.f32 $0, $1, $2, $3;",
        args=[jnp.broadcast_to(x, shape) for x in (a, b, c)],
        constraints="=f,f,f,f",
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(shape, jnp.float32)],
    )[0]


def activation(x: jax.Array, arithmetic: Arithmetic = PLAIN) -> jax.Array:
    """x sigmoid(1.702 x), the cheap approximation of GELU (Hendrycks and Gimpel, 2016),
    by one tanh.
    """
    # sigmoid(2 z) = (1 + tanh z) / 2
    half = 0.5 * x
    return arithmetic.multiply_add(half, arithmetic.tanh(0.851 * x), half)


def activation_and_slope(
    x: jax.Array, arithmetic: Arithmetic = PLAIN
) -> tuple[jax.Array, jax.Array]:
    """`activation` and its derivative."""
    share = 0.5 + 0.5 * arithmetic.tanh(0.851 * x)
    value = x * share
    return value, arithmetic.multiply_add(1.702 * value, 1.0 - share, share)
