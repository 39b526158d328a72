"""One thread per process, for programs whose processes are the parallel part; and work shared out
to them.
"""

import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

SINGLE_THREAD = {
    "JAX_PLATFORMS": "cpu",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def use_single_thread() -> None:
    """For this process, if NumPy and JAX aren't imported yet, and for those that it starts."""
    for name, value in SINGLE_THREAD.items():
        os.environ.setdefault(name, value)


def share_out(
    do: Callable, jobs: Iterable[tuple], processes: int, seconds: float = math.inf
) -> Iterator[Any]:
    """What `do(*job)` gives in one of so many processes, as it comes; none is begun after
    `seconds`.

    A job that fails is a line on standard error, and the others go on; RuntimeError at the end says
    how many did.
    """
    latest = time.time() + seconds
    failed = 0
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        try:
            job_of = {pool.submit(_in_time, do, job, latest): job for job in jobs}
            for future in as_completed(job_of):
                if error := future.exception():
                    failed += 1
                    reason = f"{str(job_of[future])[:200]}: {type(error).__name__}: {error}"
                    print(reason, file=sys.stderr, flush=True)
                elif future.result() is not None:
                    yield future.result()
        finally:  # also where who asks has failed: nobody waits for what isn't begun
            pool.shutdown(cancel_futures=True)
    if failed:
        raise RuntimeError(f"{failed} of {len(job_of)} jobs failed")


def _in_time(do, job, latest):
    return do(*job) if time.time() < latest else None
