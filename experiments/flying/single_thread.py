"""One thread per process, for programs whose processes are the parallel part."""

import os

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
