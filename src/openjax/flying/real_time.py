"""Making a process fit for real time."""

from __future__ import annotations

import os

PRIORITY = 10
"""Of the real-time scheduler: above all ordinary processes, below the kernel's own threads (50). The same for loop, links and
virtual vehicles: with the loop first and the vehicles last, late poses made the commands older (14.7 ms at p99, not 6 to 8)."""
NICE = -10


def prepare() -> None:
    """Run JAX in the calling thread.

    JAX hands each call to another thread otherwise, and on a busy machine the way there and back costs milliseconds
    in one call of a hundred. Call it before anything is computed.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def hurry() -> str:
    """Ask that this process's threads, and those they start, run before others; what was granted.

    "real time": Linux's real-time scheduler; "nice": before others, as far as they are ordinary; "ordinary": nothing.

    Linux grants the real-time scheduler to root and to users with `rtprio` in /etc/security/limits.conf. All threads:
    JAX computes in several, and the loop would wait for one that waits for its turn.
    """
    try:
        for thread in _threads():
            os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))
        return "real time"
    except (AttributeError, OSError):  # not on this system, or not ours to ask
        pass
    try:
        for thread in _threads():  # Linux's nice values are threads', too
            os.setpriority(os.PRIO_PROCESS, thread, NICE)
        return "nice"
    except (AttributeError, OSError):
        return "ordinary"


def _threads() -> list[int]:
    """The threads of this process; 0, which means it, where they can't be told."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
