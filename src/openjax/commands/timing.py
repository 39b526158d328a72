"""Timing of compiled functions: compilation apart from running, memory, and what ran out of it."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Timing:
    """One compiled function, timed."""

    compile_seconds: float
    """Tracing and compilation; a persistent compilation cache shortens it."""
    seconds: float | None
    """Median time of one call; None where it ran out of memory."""
    slowest: float | None
    """Of all calls."""
    calls: int
    memory: int | None
    """Bytes for arguments, results and temporaries of one call, by the compiler's account."""
    peak_memory: int | None
    """Most bytes that the device has held so far in this process; None where it doesn't tell (CPU)."""


def time_compiled(
    function: Callable, arguments: tuple, min_seconds: float = 1.0, min_calls: int = 3
) -> Timing:
    """Compile `function` for `arguments`, run it once to warm up, then time calls for at least `min_seconds`.

    Each call gets the same arguments and is waited for, so that all calls do the same work.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - start
    memory = _memory(compiled)
    times: list[float] = []
    try:
        jax.block_until_ready(compiled(*arguments))
        while sum(times) < min_seconds or len(times) < min_calls:
            start = time.perf_counter()
            jax.block_until_ready(compiled(*arguments))
            times.append(time.perf_counter() - start)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return Timing(compile_seconds, None, None, 0, memory, _peak_memory())
    return Timing(compile_seconds, float(np.median(times)), max(times), len(times), memory, _peak_memory())


def _memory(compiled: Any) -> int | None:
    analysis = compiled.memory_analysis()
    if analysis is None:
        return None
    return int(
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        + analysis.temp_size_in_bytes
        - analysis.alias_size_in_bytes
    )


def _peak_memory() -> int | None:
    statistics = jax.devices()[0].memory_stats()
    return None if not statistics else int(statistics.get("peak_bytes_in_use", 0)) or None
