"""Compiling in the background, so that a run's programs are compiled side by side."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def compile_ahead(function: Callable, *arguments) -> Callable[[], None]:
    """Start to compile a function of `jax.jit` for arguments of these shapes, dtypes and shardings.

    It's traced before this returns, as two threads that trace hold each other up; only the compiler runs beside.
    JAX keeps what it compiled, so that a later call of `function` finds it; a call before that compiles again.

    Args:
      function: from `jax.jit`.
      arguments: arrays, or `jax.ShapeDtypeStruct`s in their place.

    Returns:
      a function that waits for the end, and raises what went wrong in the compiler.
    """
    lowered = function.lower(*arguments)
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="compile")
    future = pool.submit(lowered.compile)
    pool.shutdown(wait=False)

    def wait() -> None:
        future.result()

    return wait
