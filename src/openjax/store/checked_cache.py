"""The cache of compiled programs, each entry with its checksum.

JAX runs what it finds in its cache: a flipped bit there ends the process, or changes a
number, and half an entry is never replaced. An entry of this cache is loaded only
whole. JAX has no public way to be given a cache, so the function of its module that
makes one is replaced; a JAX without it keeps its own.
"""

import contextlib
import logging
from pathlib import Path

from jax._src import compilation_cache
from jax._src.compilation_cache_interface import CacheInterface

from openjax.files import read_checked, write_checked

ENTRY = ".program"
"""What the names of entries end with; JAX's own entries beside them are left alone."""


class CheckedCache(CacheInterface):
    """Entries in a folder, by their keys; the folder is made where it isn't there."""

    def __init__(self, folder: Path):
        self._path = Path(folder)
        self._path.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> bytes | None:
        """The entry of a key; None where there is none, or none that is whole."""
        file = self._path / f"{key}{ENTRY}"
        content = read_checked(file)
        if content is None and file.exists():
            logging.getLogger(__name__).warning("%s is damaged and is compiled again", file)
        return content

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry; what can't be written isn't kept."""
        with contextlib.suppress(OSError):
            write_checked(self._path / f"{key}{ENTRY}", value)


def use_checked_cache() -> None:
    """Have JAX keep its compiled programs in a `CheckedCache` of the folder that it's
    told of.
    """
    if not isinstance(compilation_cache._cache, CheckedCache):
        compilation_cache.reset_cache()
        compilation_cache.get_file_cache = lambda path: (CheckedCache(path), path)
