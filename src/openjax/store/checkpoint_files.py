"""One checkpoint on disk: it appears whole or not at all, and a changed byte is found.

It is a folder of orbax's and, written after it, NAME.sha256 with the checksums of all
its files: it counts once that is there, and only while they agree. Orbax stands behind
this module only.

A carry is any pytree of arrays; optimiser states, typed random keys and counters are
leaves like all others, so nothing can be forgotten. Leaves are stored under their path
in the tree, which makes a carry of another shape a readable error instead of a wrong
run.
"""

import functools
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.files import flush, write_text
from openjax.store.leaves import first_device, named_leaves

_CHECKSUMS = ".sha256"


class DamagedError(UserError):
    """A checkpoint's files aren't as they were written."""


def save_state(path: Path, carry: Any, notes: dict | None = None) -> None:
    """Write one carry to the directory `path`, in place of what is there; it appears
    whole or not at all.
    """
    path = Path(path)
    if jax.process_index() == 0:
        remove_state(path)
    commit(path, start_save(path, carry, notes or {}))


def load_state(path: Path, abstract: Any) -> Any:
    """Read a carry whose shapes, dtypes and shardings are those of `abstract` (from
    `abstract_like`).

    Raises:
      UserError: not a checkpoint, a damaged one (`DamagedError`), or one of another
      shape.
    """
    path = Path(path).absolute()
    check_state(path)
    metadata = load_orbax().metadata(path).metadata
    shapes = {name: leaf for name, leaf in named_leaves(abstract).items() if leaf.size}
    _check_same_shapes(path, metadata, shapes)
    arrays = load_orbax().load(path, shapes)
    # Orbax can't write arrays without elements; they hold nothing, so they are made
    # anew.
    leaves = [
        arrays[name] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype, device=leaf.sharding)
        for name, leaf in named_leaves(abstract).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(abstract), leaves)


def load_arrays(
    path: Path, name_of: Callable[[str], str | None] = lambda name: name
) -> dict[str, np.ndarray]:
    """Leaves as host arrays, without knowing the tree, read by this process alone.

    Args:
      path: the checkpoint.
      name_of: path in the tree -> name in what is returned; None: isn't read.

    Raises:
      UserError: not a checkpoint, or a damaged one.
    """
    path = Path(path).absolute()
    check_state(path)
    sharding = first_device()
    metadata = load_orbax().metadata(path).metadata
    names = {name: name_of(name) for name in metadata}
    abstract = {}
    for name, leaf in metadata.items():
        abstract[name] = jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
        if names[name] is None:  # not read at all
            abstract[name] = load_orbax().PLACEHOLDER
    # else Orbax would wait for the other processes
    context = load_orbax().Context()
    context.multiprocessing.primary_host = jax.process_index()
    context.multiprocessing.active_processes = {jax.process_index()}
    with context:
        checkpoint = load_orbax().load(path, abstract)

    def plain(leaf):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    return {
        names[name]: plain(leaf) for name, leaf in checkpoint.items() if names[name] is not None
    }


def is_checkpoint(path: Path) -> bool:
    """True for a finished checkpoint, whether its files are still as they were written
    or not.
    """
    path = Path(path)
    return path.is_dir() and _checksums_file(path).is_file()


def start_save(path: Path, carry: Any, notes: dict) -> Any:
    """Hand a carry to orbax, which writes it beside what follows; `commit` waits for
    it. Its arrays are copied then.
    """
    arrays = {name: leaf for name, leaf in named_leaves(carry).items() if leaf.size}
    path.parent.mkdir(parents=True, exist_ok=True)
    return load_orbax().save_async(path.absolute(), arrays, custom_metadata=notes)


def commit(path: Path, write: Any) -> None:
    """Wait until orbax has written a checkpoint, and seal it by its checksums."""
    write.result()
    if jax.process_index() == 0:
        # on the disk before the checksums are, as a checkpoint counts once these are
        # there
        for path_written in (*_files(path), path, path.parent):
            flush(path_written)
        lines = [f"{_checksum(file)}  {file.relative_to(path).as_posix()}" for file in _files(path)]
        write_text(_checksums_file(path), "\n".join(lines) + "\n")


def check_state(path: Path) -> None:
    """Raises UserError where no checkpoint is, and DamagedError where its files aren't
    as they were written.
    """
    if not is_checkpoint(path):
        raise UserError(f"{path} is no checkpoint; expected a directory written by openjax.train")
    try:
        lines = _checksums_file(path).read_text(encoding="utf-8").splitlines()
        checksums = {}
        for line in lines:
            checksum, _, name = line.partition("  ")
            checksums[name] = checksum
        actual = {file.relative_to(path).as_posix(): _checksum(file) for file in _files(path)}
        # names that only one of them has, or with another checksum
        different = sorted(dict(checksums.items() ^ actual.items()))
    except (OSError, UnicodeDecodeError) as error:
        raise DamagedError(f"checkpoint {path} is damaged ({error})") from error
    if different or not checksums:
        place = different[0] if different else _CHECKSUMS
        raise DamagedError(f"checkpoint {path} is damaged: {place[:80]} isn't as it was written")


def remove_state(path: Path) -> None:
    """Delete a checkpoint; its checksums go first, so that a half-deleted one is
    none.
    """
    _checksums_file(path).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)


@functools.cache
def load_orbax():
    """Loaded late: it takes a second or two, which pass while a run's programs are
    compiled.
    """
    from orbax.checkpoint.experimental import v1

    return v1


def _files(path):
    return sorted(file for file in path.rglob("*") if file.is_file())


def _checksum(file):
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _checksums_file(path):
    return path.with_name(path.name + _CHECKSUMS)


def _check_same_shapes(path, metadata, leaves):
    """Raises UserError where a checkpoint's leaves aren't these."""
    reason = "other settings or another version wrote it"
    for name, leaf in leaves.items():
        if name not in metadata:
            raise UserError(f"checkpoint {path} lacks {name}; {reason}")
        # Orbax writes a random key as its numbers
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        shape_of_leaf = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
        shape = tuple(metadata[name].shape)
        if shape != tuple(shape_of_leaf.shape) or metadata[name].dtype != shape_of_leaf.dtype:
            raise UserError(
                f"checkpoint {path} is of another shape: {name} is "
                f"{metadata[name].dtype}{list(shape)} there, the settings make it "
                f"{shape_of_leaf.dtype}{list(shape_of_leaf.shape)}"
            )
    for name in metadata:
        if name not in leaves:
            raise UserError(f"checkpoint {path} also holds {name}; {reason}")
