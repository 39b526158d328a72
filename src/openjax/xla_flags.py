"""A flag of JAX's compiler without which one release of it computes wrong numbers.

On a CPU, jaxlib 0.10.2 hands sums to a library that leaves rows out: a jitted `vmap` of
a matrix-vector product and a sum of squares is wrong from 32,769 rows in float32
(https://github.com/jax-ml/jax/issues/39103). It is the newest release for Python 3.11,
so it can't be refused. Without that library for sums, the same program is right.
"""

import os
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

FAULTY = ("0.10.2",)
"""Releases of jaxlib with the fault; of them it is known, too, that they know the flag,
as an unknown one ends the process.
"""
FLAG = "--xla_cpu_experimental_ynn_fusion_type"
WITHOUT_SUMS = f"{FLAG}=-reduce"


def avoid_wrong_sums() -> None:
    """Add the flag to XLA_FLAGS where jaxlib has the fault and nobody has set that
    flag.

    JAX reads XLA_FLAGS when it first looks for its devices. Where that has happened,
    one line warns that sums may be wrong, and says what to do.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG in flags or _jaxlib_version() not in FAULTY:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {WITHOUT_SUMS}".strip()
    if _computes_on_cpu():
        warnings.warn(
            "JAX computed before openjax was imported, and JAX 0.10.2 may sum wrongly on a CPU "
            f"(JAX issue 39103): import openjax first, or set XLA_FLAGS={WITHOUT_SUMS}",
            RuntimeWarning,
            # the line that imports openjax; frames of importing itself are left out
            stacklevel=3,
        )


def _jaxlib_version():
    """None where jaxlib isn't installed, of which JAX itself tells best."""
    try:
        return version("jaxlib")
    except PackageNotFoundError:
        return None


def _computes_on_cpu():
    """True if JAX has found its devices and computes on CPUs unless told otherwise."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None or not bridge.backends_are_initialized():
        return False
    return sys.modules["jax"].default_backend() == "cpu"
