"""Making a process fit for real time."""

import contextlib
import gc
import os

PRIORITY = 10
"""Of the real-time scheduler: above all ordinary processes, below the kernel's own
threads (50). The same for loop, links and virtual vehicles: with the loop first and the
vehicles last, late poses made the commands older (14.7 ms at p99, not 6 to 8).
"""
NICE = -10
"""Of ordinary processes, where the real-time scheduler isn't granted: half of the way to first."""
IN_LINE = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
"""Options of XLA's CPU compiler, see `compile_in_line`."""


def prepare() -> None:
    """Run JAX in the calling thread.

    JAX hands each call to another thread otherwise, and on a busy machine the way there and back
    costs milliseconds in one call of a hundred. Call it before anything is computed.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def compile_in_line(program):
    """Compile a lowered function so that its operations run one after the other in the
    thread that calls it.

    XLA's CPU compiler otherwise arranges them for its worker threads, and on a busy
    machine a call waits for those: of 1,500 ticks of the loop on two cores at a load of
    nine 1.3 ms at the median, 9.9 at p99; in line .8 and 2.7.
    """
    try:
        return program.compile(compiler_options=IN_LINE)
    except (RuntimeError, ValueError, TypeError):  # a compiler that knows no such option
        return program.compile()


def hurry() -> str:
    """Have this process's threads, and those they start, run before others, and nothing
    that is loaded searched for garbage; what was granted: "real time", Linux's
    scheduler; "nice", before others as far as they are ordinary; "ordinary", nothing.

    Linux grants the real-time scheduler to root and to users with `rtprio` in
    /etc/security/limits.conf. All threads: JAX computes in several, and the loop would
    wait for one that waits for its turn.
    """
    # a look through all of JAX's objects takes .1 s: for so long no virtual vehicle
    # would say where it is
    gc.freeze()
    for name, ask in (("real time", _schedule_first), ("nice", _be_less_nice)):
        # not on this system, or not ours to ask
        with contextlib.suppress(AttributeError, OSError):
            for thread in _threads():
                ask(thread)
            return name
    return "ordinary"


def _schedule_first(thread: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))


def _be_less_nice(thread: int) -> None:
    os.setpriority(os.PRIO_PROCESS, thread, NICE)  # on Linux of a thread, too


def _threads() -> list[int]:
    """The threads of this process; 0, which means it, where they can't be told."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
