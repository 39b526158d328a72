"""Compiling: once per machine, by a cache that lasts, and in the background, so that programs are compiled side by side."""

import hashlib
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

from openjax.background import in_background

CACHE_SIZE = 2 * 2**30
"""Bytes that the cache of compiled programs may take; what was used longest ago goes first."""

_WORTH_KEEPING = 0.5
"""Seconds of compilation from which a program is kept."""


def cache_programs() -> Path | None:
    """Have JAX keep compiled programs in the user's cache folder, and take them from there next time.

    JAX itself knows a program again by its code, its compiler and its devices; the folder is this processor's, as code
    for one need not run on another that shares the home. Where JAX was already told of a folder
    (JAX_COMPILATION_CACHE_DIR), that one is used.

    Returns:
      the folder; None where none can be written to, so that nothing is kept.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is not None:
        return Path(jax.config.jax_compilation_cache_dir)
    folder = _user_cache() / "openjax" / f"{jax.__version__}-{_processor_key()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _bound(folder.parent, CACHE_SIZE)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    return folder


def _user_cache():
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if os.name == "nt" and os.environ.get("LOCALAPPDATA"):
        return Path(os.environ["LOCALAPPDATA"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _processor_key():
    """A short name of this kind of processor, its instructions included."""
    text = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        text += "".join(
            sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
        )
    except OSError:
        pass
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _bound(folder, size):
    """Delete the files of a folder that were used longest ago, until they take at most `size` bytes."""
    files = []
    for path in folder.rglob("*"):
        if path.is_file():
            status = path.stat()
            files.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = sum(entry[1] for entry in files)
    for _, bytes_, path in sorted(files, key=lambda entry: entry[0]):
        if total <= size:
            return
        path.unlink(missing_ok=True)
        total -= bytes_


def compile_ahead(function: Callable, *arguments) -> Callable[..., bool]:
    """Start to compile a function of `jax.jit` for arguments of these shapes, dtypes and shardings.

    It's traced before this returns, as two threads that trace hold each other up; only the compiler runs beside.
    JAX keeps what it compiled, so that a later call of `function` finds it; a call before that compiles again.

    Args:
      function: from `jax.jit`.
      arguments: arrays, or `jax.ShapeDtypeStruct`s in their place.

    Returns:
      a function that waits for the end, for at most as many seconds as it is given, and raises what went wrong in the
      compiler; it returns whether the end was reached.
    """
    ready = in_background(function.lower(*arguments).compile)

    def wait(seconds: float | None = None) -> bool:
        try:
            ready(seconds)
        except TimeoutError:
            if seconds is None:  # the compiler's own
                raise
            return False
        return True

    return wait
