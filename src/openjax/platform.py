"""Choosing between a formula and its hand-written kernel, and what kernels need of their arrays."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp


def on_platform(reference: Callable, kernel: Callable, *static) -> Callable:
    """A function of arrays that runs `kernel` on NVIDIA GPUs and `reference` elsewhere; `static` come first."""

    def run(*arrays):
        return jax.lax.platform_dependent(
            *arrays, default=functools.partial(reference, *static), cuda=functools.partial(kernel, *static)
        )

    return run


def whole_blocks(array: jax.Array, size: int, axis: int = 0, mode: str = "constant") -> jax.Array:
    """`array` padded at the end of `axis` to a multiple of `size`, for a kernel that works on whole blocks."""
    extra = -array.shape[axis] % size
    widths = [(0, extra if i == axis else 0) for i in range(array.ndim)]
    return jnp.pad(array, widths, mode=mode) if extra else array
