"""Choosing between a formula and its hand-written kernel."""

import functools
from collections.abc import Callable

import jax


def on_platform(reference: Callable, kernel: Callable, *static) -> Callable:
    """A function of arrays that runs `kernel` on NVIDIA GPUs and `reference` elsewhere; `static` come first."""

    def run(*arrays):
        return jax.lax.platform_dependent(
            *arrays, default=functools.partial(reference, *static), cuda=functools.partial(kernel, *static)
        )

    return run
