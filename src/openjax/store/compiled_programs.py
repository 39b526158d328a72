"""Compiled programs: kept in a folder of the user's own, so that a machine compiles
each of them once.
"""

import contextlib
import hashlib
import logging
import os
import platform
import stat
import sys
from pathlib import Path

CACHE_SIZE = 2 * 2**30
"""Bytes that the cache of compiled programs may take; what was used longest ago goes
first.
"""

_LOGGER = logging.getLogger(__name__)
_WORTH_KEEPING = 0.5
"""Seconds of compilation from which a program is kept."""


def cache_programs() -> Path | None:
    """Have JAX keep compiled programs in the user's cache folder, each with a checksum,
    and take them from there next time.

    JAX itself knows a program again by its code, its compiler and its devices; the
    folder is this processor's, as code for one need not run on another that shares the
    home. Where JAX was already told of a folder (JAX_COMPILATION_CACHE_DIR), that one
    is used.

    Returns:
      the folder; None where no folder of the user's own can be written to, so that
      nothing is kept.
    """
    import jax

    from openjax.store.checked_cache import use_checked_cache

    setting = jax.config.jax_compilation_cache_dir
    if setting is not None and "://" in setting:  # a bucket; JAX reads it by itself
        return Path(setting)
    folder = _own_folder() if setting is None else Path(setting)
    if folder is None:
        return None
    if setting is not None and folder.exists() and not _is_private(folder):
        _LOGGER.warning(
            "others can write to %s, and so run what they like here: chmod go-w it", folder
        )
    use_checked_cache()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # XLA's own caches have no checksums
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    if setting is None:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    return folder


def _own_folder():
    """A folder that only this user can write to, as a program in it is run; None where
    none can be had.
    """
    import jax

    # RuntimeError: a user without a home
    with contextlib.suppress(OSError, RuntimeError):
        top = _user_cache() / "openjax"
        top.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_private(top):
            # by JAX's version too: what another one compiled is never asked for again,
            # and is deleted in its turn
            folder = top / f"{jax.__version__}-{_processor_key()}"
            folder.mkdir(exist_ok=True)
            _bound(top, CACHE_SIZE)
            return folder
    return None


def _is_private(folder):
    """True if it's a folder, no link to one, this user's, and nobody else can write to it."""
    status = folder.lstat()
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()
        and not status.st_mode & 0o022
    )


def _user_cache():
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _processor_key():
    """A short name of this kind of processor, its instructions included."""
    text = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        prefixes = ("model name", "flags", "Features")
        text += "".join(sorted({line for line in lines if line.startswith(prefixes)}))
    except OSError:
        pass
    # enough to tell a user's machines apart, and short in a path
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _bound(folder, size):
    """Delete the files of a folder that were used longest ago, until they take at most
    `size` bytes.
    """
    files = [(path.stat(), path) for path in folder.rglob("*") if path.is_file()]

    def last_use(file):
        # a file system may not note when a file was read
        return max(file[0].st_atime, file[0].st_mtime)

    total = 0
    for status, path in sorted(files, key=last_use, reverse=True):
        total += status.st_size
        if total > size:
            path.unlink(missing_ok=True)
