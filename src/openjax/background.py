"""Compiling: side by side, in threads of their own, and without noise."""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax


def in_background(make: Callable[[], Any]) -> Callable[..., Any]:
    """Start to make something in a thread of its own; a function that waits for it and
    returns it, or raises its error.

    Given seconds, it waits no longer and then raises `TimeoutError`.
    """
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="background")
    future = pool.submit(make)
    pool.shutdown(wait=False)
    return future.result


def compile_ahead(function: Callable, *arguments) -> Callable[..., Any]:
    """Start to compile a function of `jax.jit` for arguments of these shapes, dtypes
    and shardings.

    It's traced before this returns, as two threads that trace hold each other up; only
    the compiler runs beside. JAX keeps what it compiled, so that a later call of
    `function` finds it; a call before that compiles again.

    Args:
      function: from `jax.jit`.
      arguments: arrays, or `jax.ShapeDtypeStruct`s in their place.

    Returns:
      a function that waits for the end, see `in_background`.
    """
    return in_background(function.lower(*arguments).compile)


@contextlib.contextmanager
def quiet_compiler() -> Iterator[None]:
    """Keep XLA from logging how long it takes, as an error to be filed; what does go
    wrong is raised.
    """
    level = jax.config.jax_logging_level
    jax.config.update("jax_logging_level", "CRITICAL")
    try:
        yield
    finally:
        # XLA's own level has no "as before": it is set by one that it knows, then JAX's
        # is put back
        jax.config.update("jax_logging_level", level or "WARNING")
        jax.config.update("jax_logging_level", level)
