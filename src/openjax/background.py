"""Threads: work side by side, compiling beside other work, and without noise."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
from threadpoolctl import threadpool_limits

MOST = 2
"""Threads that compute side by side: beyond, they wait for the interpreter."""


def side_by_side(function: Callable, items: Iterable) -> list:
    """[function(item) of every item], several at once: NumPy and XLA leave the
    interpreter to others while they compute. What the environment tells OpenMP, that a
    process is one of many, holds here too.
    """
    items = list(items)
    cores = os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    threads = min(MOST, cores, int(limit) if limit.isdigit() else MOST, len(items))
    if threads < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorates a function in which NumPy and SciPy compute each product on one core. Of products as
small as a diagnosis', threads wait for each other for longer than they compute: beside other work
one took 80 s with them and 20 s without.
"""


class Pending:
    """Something that is being made in a thread of its own; called, it waits for it."""

    def __init__(self, future: Future):
        self._future = future

    def __call__(self, seconds: float | None = None) -> Any:
        """Return what was made. Raises the error of its making, and `TimeoutError` if it isn't
        there after so many seconds.
        """
        return self._future.result(seconds)

    @property
    def is_ready(self) -> bool:
        """True if nobody would have to wait."""
        return self._future.done()


def in_background(make: Callable[[], Any]) -> Pending:
    """Start to make something in a thread of its own."""
    return one_by_one([make])[0]


def one_by_one(makes: Iterable[Callable[[], Any]]) -> list[Pending]:
    """Start to make several things, each after the one before it, in a thread of their
    own.
    """
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="background")
    pending = [Pending(pool.submit(make)) for make in makes]
    pool.shutdown(wait=False)
    return pending


def compile_ahead(function: Callable, *arguments) -> Pending:
    """Start to compile a function of `jax.jit` for arguments of these shapes, dtypes
    and shardings.

    It's traced before this returns, as two threads that trace hold each other up; only
    the compiler runs beside. JAX keeps what it compiled, so that a later call of
    `function` finds it; a call before that compiles again.

    Args:
      function: from `jax.jit`.
      arguments: arrays, or `jax.ShapeDtypeStruct`s in their place.

    Returns:
      what waits for the compiler.
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
