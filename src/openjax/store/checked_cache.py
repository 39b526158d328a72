"""The cache of compiled programs, each entry with its checksum.

JAX runs what it finds in its cache: a flipped bit there ends the process, or changes a number. An entry of this cache is
loaded only whole. JAX has no public way to be given a cache, so two functions of its module are replaced; a JAX without
them keeps nothing.
"""

import contextlib
import logging
import os
import tempfile
import threading
import weakref
from collections.abc import Iterator
from pathlib import Path

from jax._src import compilation_cache
from jax._src.compilation_cache_interface import CacheInterface

from openjax.files import read_checked, write_checked

try:
    import fcntl
except ImportError:  # Windows: deaths while loading aren't noticed
    fcntl = None

ENTRY = ".program"
"""What the names of entries end with; JAX's own entries beside them are left alone."""
ASIDE = ".aside"
"""What the names of entries end with that are never loaded again."""
_LOADING = "loading-"


class CheckedCache(CacheInterface):
    """Entries in a folder, by their keys.

    While the process loads some, a file that it holds locked names them: one that nobody holds was left by a death.

    Args:
      folder: where the entries lie; it is made where it isn't there.
    """

    def __init__(self, folder: Path):
        self._path = Path(folder)
        self._path.mkdir(parents=True, exist_ok=True)
        self._guard, self._names = threading.Lock(), []
        self._journal, path = _locked_file(self._path) if fcntl else (None, None)
        if path is not None:
            weakref.finalize(self, path.unlink, missing_ok=True)

    def get(self, key: str) -> bytes | None:
        """The entry of a key; None where there is none. One that isn't whole is set aside."""
        file = self._path / f"{key}{ENTRY}"
        content = read_checked(file)
        if content is None and file.exists():
            logging.getLogger(__name__).warning("%s is damaged, and is compiled anew", file)
            _set_aside(file)
        return content

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry; what can't be written isn't kept."""
        with contextlib.suppress(OSError):
            write_checked(self._path / f"{key}{ENTRY}", value)

    @contextlib.contextmanager
    def loading(self, key: str) -> Iterator[None]:
        """While an entry is loaded: should the process die, `set_fatal_entries_aside` knows which one it was."""
        self._note(self._names.append, key)
        try:
            yield
        finally:
            self._note(self._names.remove, key)

    def _note(self, change, key):
        with self._guard:
            change(key)
            if self._journal is not None:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._journal, 0)
                    os.pwrite(self._journal, "\n".join(self._names).encode(), 0)


def set_fatal_entries_aside(folder: Path) -> list[str]:
    """Take entries out of use that a process was loading when it died; returns their keys."""
    found = []
    for path in folder.glob(f"{_LOADING}*") if fcntl else ():
        with contextlib.suppress(OSError), open(path) as journal:  # its process lives, or somebody was faster
            fcntl.flock(journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found += journal.read().split()
            path.unlink()
    for key in found:
        _set_aside(folder / f"{key}{ENTRY}")
    return found


def use_checked_cache() -> None:
    """Have JAX keep its compiled programs in a `CheckedCache` of the folder that it's told of."""
    load = compilation_cache.get_executable_and_time
    if getattr(load, "is_checked", False):
        return

    def checked_load(key, *arguments, **options):
        cache = compilation_cache._cache
        with cache.loading(key) if isinstance(cache, CheckedCache) else contextlib.nullcontext():
            return load(key, *arguments, **options)

    checked_load.is_checked = True
    compilation_cache.reset_cache()
    compilation_cache.get_file_cache = lambda path: (CheckedCache(path), path)
    compilation_cache.get_executable_and_time = checked_load


def _locked_file(folder):
    """A file in the folder that this process holds locked as long as it lives.

    It gets its name once it's locked, or another process might take it for one that was left. Returns its descriptor
    and path; None twice where it can't be had.
    """
    try:
        descriptor, path = tempfile.mkstemp(prefix=".", dir=folder)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path = Path(path).rename(folder / f"{_LOADING}{Path(path).name[1:]}")
    except OSError:
        return None, None
    return descriptor, path


def _set_aside(file):
    with contextlib.suppress(OSError):
        os.replace(file, file.with_suffix(ASIDE))
