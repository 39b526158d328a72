"""Work in a thread beside: programs are compiled side by side."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def in_background(make: Callable[[], Any]) -> Callable[[], Any]:
    """Start to make something in a thread of its own; a function that waits for it and returns it, or raises its error."""
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="background")
    future = pool.submit(make)
    pool.shutdown(wait=False)
    return future.result
