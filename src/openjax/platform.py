"""The hardware of this machine: cores as devices; a formula or its hand-written kernel, and what
kernels need of arrays.
"""

import contextlib
import functools
import importlib.util
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp

MOST_CORES = 4
"""Cores that become devices: of more, some are other cores' second threads."""


def make_cores_devices() -> None:
    """Have JAX see a processor's cores as devices, before anything asks for them.

    Worlds are shared out to devices whole, while most operations on all of them are too
    short for several threads. It does nothing where there may be an accelerator, or the
    number of devices was asked for.
    """
    accelerator = can_compile_for_cuda() and jax.config.jax_platforms != "cpu"
    by_flag = "device_count" in os.environ.get("XLA_FLAGS", "")
    is_chosen = jax.config.jax_num_cpu_devices >= 0 or by_flag
    if not accelerator and not is_chosen:
        # those that this process may use: a container has fewer than the machine
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        with contextlib.suppress(RuntimeError):  # somebody asked before
            jax.config.update("jax_num_cpu_devices", min(cores or 1, MOST_CORES))


@functools.cache
def can_compile_for_cuda() -> bool:
    """True if JAX's CUDA compiler is installed: without it, no kernels are asked for, and they
    needn't be traced.
    """
    if importlib.util.find_spec("jax_plugins") is None:
        return False
    plugins = ("jax_plugins.xla_cuda13", "jax_plugins.xla_cuda12")
    return any(importlib.util.find_spec(plugin) is not None for plugin in plugins)


def on_platform(reference: Callable, kernel: Callable, *static) -> Callable:
    """A function of arrays that runs `kernel` on NVIDIA GPUs and `reference` elsewhere;
    `static` come first.
    """

    by_formula = functools.partial(reference, *static)
    by_kernel = functools.partial(kernel, *static)

    def run(*arrays):
        if not can_compile_for_cuda():
            return by_formula(*arrays)
        return jax.lax.platform_dependent(*arrays, default=by_formula, cuda=by_kernel)

    return run


def whole_blocks(array: jax.Array, size: int, axis: int = 0, mode: str = "constant") -> jax.Array:
    """`array` padded at the end of `axis` to a multiple of `size`, for a kernel that
    works on whole blocks.
    """
    extra = -array.shape[axis] % size
    widths = [(0, extra if i == axis else 0) for i in range(array.ndim)]
    return jnp.pad(array, widths, mode=mode) if extra else array
