"""Making a process fit for real time."""

from __future__ import annotations

import os


def prepare(nice: int = -10) -> bool:
    """Run JAX in the calling thread and ask for a better priority; whether that was granted.

    JAX hands each call to another thread otherwise, and on a busy machine the way there and back costs milliseconds
    in one call of a hundred. Call it before anything is computed.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, nice)
    except (AttributeError, OSError):  # not on this system, or not ours to ask
        return False
    return True
