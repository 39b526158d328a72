"""Checkpoints of a whole training carry: atomic, exact, the last good one found again after any kill or damage.

A checkpoint NAME is a folder of orbax's and, written after it, NAME.sha256 with the checksums of all its files: it
counts once that is there, and only while they agree. Orbax stands behind this module only.

A carry is any pytree of arrays; optimiser states, typed random keys and counters are leaves like all others, so nothing
can be forgotten. Leaves are stored under their path in the tree, which makes a carry of another shape a readable error
instead of a wrong run.
"""

import dataclasses
import functools
import hashlib
import shutil
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.files import WRITING, write_text

_DIGITS = 9
_CHECKSUMS = ".sha256"


@dataclasses.dataclass(frozen=True)
class CheckpointRecord:
    """One committed checkpoint on disk."""

    path: Path
    update: int
    """Training updates done when it was written."""
    score: float | None
    """Score of the validation at this update; None where none was made."""
    notes: dict
    """Host-side facts that a resumed run goes on from (seconds so far and the like)."""
    score_rule: int = 1
    """How the score was made; only scores of one rule can be compared."""


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their path, for example `actor/params/Dense_0/kernel`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def place(carry: Any, shardings: Any = None) -> Any:
    """Commit every leaf to its devices, so that a fresh and a restored carry hit the same compiled step.

    Args:
      carry: pytree of arrays.
      shardings: None (the first device) or a sharding or a pytree prefix of them.
    """
    shardings = _default_sharding() if shardings is None else shardings
    if all(sharding.is_fully_addressable for sharding in jax.tree.leaves(shardings)):
        return jax.device_put(carry, shardings)
    # Devices of other processes: each process has the whole carry and hands in its own devices' share.
    is_key = jax.tree.map(lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key), carry)
    arrays = jax.tree.map(
        lambda leaf, key: np.asarray(jax.random.key_data(leaf) if key else leaf), carry, is_key
    )
    implementations = jax.tree.map(
        lambda leaf, key: jax.random.key_impl(leaf) if key else None, carry, is_key
    )

    def whole(arrays):
        return jax.tree.map(
            lambda leaf, key, kind: jax.random.wrap_key_data(leaf, impl=kind) if key else leaf,
            arrays,
            is_key,
            implementations,
        )

    return jax.jit(whole, out_shardings=shardings)(arrays)


def abstract_like(carry: Any, shardings: Any = None) -> Any:
    """Shapes, dtypes and shardings of a carry that `place` put, or would put, on its devices.

    Args:
      carry: pytree of arrays, or of their shapes and dtypes.
      shardings: as for `place`.
    """
    shardings = _default_sharding() if shardings is None else shardings
    return jax.tree.map(
        lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
        carry,
        jax.tree.broadcast(shardings, carry),
    )


def save_state(path: Path, carry: Any, notes: dict | None = None) -> None:
    """Write one carry to the directory `path`, in place of what is there; it appears whole or not at all."""
    path = Path(path)
    if jax.process_index() == 0:
        _remove(path)
    _commit(path, _start_save(path, carry, notes or {}))


def load_state(path: Path, abstract: Any) -> Any:
    """Read a carry whose shapes, dtypes and shardings are those of `abstract` (from `abstract_like`).

    Raises:
      UserError: not a checkpoint, a damaged one (`DamagedError`), or one of another shape.
    """
    path = Path(path).absolute()
    _check(path)
    stored = load_orbax().metadata(path).metadata
    wanted = {name: leaf for name, leaf in named_leaves(abstract).items() if leaf.size}
    _check_same_shapes(path, stored, wanted)
    arrays = load_orbax().load(path, wanted)
    # Orbax can't write arrays without elements; they hold nothing, so they are made anew.
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
    _check(path)
    sharding = _default_sharding()
    stored = load_orbax().metadata(path).metadata
    names = {name: name_of(name) for name in stored}
    wanted = {
        name: load_orbax().PLACEHOLDER
        if names[name] is None
        else jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
        for name, leaf in stored.items()
    }
    this = jax.process_index()
    alone = load_orbax().options.MultiprocessingOptions(primary_host=this, active_processes={this})
    with load_orbax().Context(multiprocessing_options=alone):
        loaded = {
            names[name]: leaf
            for name, leaf in load_orbax().load(path, wanted).items()
            if names[name] is not None
        }
    is_key = {name: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for name, leaf in loaded.items()}
    return {
        name: np.asarray(jax.random.key_data(leaf) if is_key[name] else leaf) for name, leaf in loaded.items()
    }


def is_checkpoint(path: Path) -> bool:
    """True for a finished checkpoint, whether its files are still as they were written or not."""
    path = Path(path)
    return path.is_dir() and _checksums_file(path).is_file()


class DamagedError(UserError):
    """A checkpoint's files aren't as they were written."""


class Checkpoints:
    """The checkpoints of one run: the last few and the best by validation are kept.

    Of several processes all write and read their part, in the same order; they share the directory.

    Args:
      directory: where they lie; made with the first of them.
      keep_last: how many of the newest are kept.
      processes: that share the directory; None: this one alone.
      score_rule: of the scores that are handed in. In a run that began by an earlier rule, any of this one is better.
    """

    def __init__(
        self,
        directory: Path,
        keep_last: int = 2,
        processes: Processes | None = None,
        score_rule: int = 1,
    ):
        self.directory = Path(directory).absolute()
        self.keep_last = keep_last
        self.score_rule = score_rule
        self._processes = processes or Processes()
        self._pending: Future | None = None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoint")
        self._known: dict[str, CheckpointRecord] = {}  # a finished checkpoint doesn't change
        self._damaged: dict[str, str] = {}

    def records(self) -> list[CheckpointRecord]:
        """Finished and undamaged checkpoints, oldest first."""
        found = []
        for path in sorted(self.directory.glob("[0-9]" * _DIGITS)):
            if not is_checkpoint(path) or path.name in self._damaged:
                continue
            if path.name not in self._known:
                try:
                    self._known[path.name] = _record(path)
                except DamagedError as error:
                    self._damaged[path.name] = str(error)
                    continue
            found.append(self._known[path.name])
        return found

    def any_finished(self) -> bool:
        """Whether there is a checkpoint, damaged or not."""
        return any(is_checkpoint(path) for path in self.directory.glob("[0-9]" * _DIGITS))

    def load_best(
        self, name_of: Callable[[str], str | None], warn: Callable[[str], None]
    ) -> tuple[dict[str, np.ndarray], CheckpointRecord]:
        """Leaves (see `load_arrays`) of the best checkpoint, or of the latest where none has a score.

        One that is damaged is passed over with a warning.

        Raises:
          UserError: none is left.
        """
        while record := self.best() or self.latest():
            try:
                return load_arrays(record.path, name_of), record
            except DamagedError as error:
                warn(f"{error}; using the next best")
                self._damaged[record.path.name] = str(error)
        raise UserError(f"{self.directory} holds no checkpoint that can be read")

    def best(self) -> CheckpointRecord | None:
        """The highest score by the newest rule, the later one of equals; None while nothing was evaluated."""
        scored = [record for record in self.records() if record.score is not None]
        return (
            max(scored, key=lambda record: (record.score_rule, record.score, record.update))
            if scored
            else None
        )

    def latest(self) -> CheckpointRecord | None:
        """The newest committed checkpoint."""
        records = self.records()
        return records[-1] if records else None

    def save(self, update: int, carry: Any, score: float | None = None, notes: dict | None = None) -> None:
        """Start writing a checkpoint; returns when the arrays are copied, so that the carry may be donated.

        A second save of the same update is ignored: training is deterministic, the content would be the same.
        """
        self.wait()
        path = self.directory / f"{update:0{_DIGITS}d}"
        if self._processes.of_first(is_checkpoint(path) and path.name not in self._damaged):
            return
        if self._processes.is_first:
            _remove(path)
            self._known.pop(path.name, None), self._damaged.pop(path.name, None)
        scored = {"score": score, "score_rule": self.score_rule}
        started = _start_save(path, carry, {**(notes or {}), **scored})
        self._pending = self._pool.submit(_commit, path, started)

    def wait(self) -> None:
        """Block until the checkpoint under way is on disk, then drop the ones that are no longer kept."""
        if self._pending is None:
            return
        pending, self._pending = self._pending, None
        pending.result()
        if not self._processes.is_first:
            return
        records, best = self.records(), self.best()
        for record in records[: -self.keep_last]:
            if best is None or record.path != best.path:
                _remove(record.path)

    def restore_latest(self, abstract: Any, warn=lambda text: None) -> tuple[Any, CheckpointRecord]:
        """The newest checkpoint that can be read; damaged ones are passed over with a warning.

        Raises:
          UserError: there is none, or it holds a carry of another shape.
        """
        self.remove_unfinished()
        records = {record.path.name: record for record in self.records()}
        for text in self._damaged.values():
            warn(f"{text}; using the one before it")
        for name in reversed(self._processes.of_first(list(records))):
            path, failure, carry = self.directory / name, None, None
            try:
                carry = load_state(path, abstract)
            except DamagedError:
                failure = "damaged"
            except UserError:
                raise
            except Exception as error:  # orbax and tensorstore raise many kinds on damaged files
                failure = type(error).__name__
            failures = [failure for failure in self._processes.everyone(failure) if failure]
            if not failures:
                return carry, records[name]
            warn(f"{path} can't be read ({failures[0]}), using the one before it")
        raise UserError(f"{self.directory} holds no checkpoint that can be read")

    def remove_unfinished(self) -> None:
        """Delete what a killed write left behind."""
        if not self._processes.is_first or not self.directory.is_dir():
            return
        for path in list(self.directory.iterdir()):
            if path.is_dir() and not is_checkpoint(path):
                shutil.rmtree(path, ignore_errors=True)
            elif path.name.startswith(WRITING):
                path.unlink(missing_ok=True)


@functools.cache
def load_orbax():
    """Loaded late: it takes a second or two, which pass while a run's programs are compiled."""
    from orbax.checkpoint.experimental import v1

    return v1


def _record(path):
    """What is known of a checkpoint. Raises DamagedError."""
    _check(path)
    try:
        notes = dict(load_orbax().metadata(path.absolute()).custom_metadata or {})
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise DamagedError(f"checkpoint {path} can't be read ({type(error).__name__})") from error
    score, rule = notes.pop("score", None), notes.pop("score_rule", 1)
    return CheckpointRecord(path, int(path.name), score, notes, rule)


def _commit(path, started):
    """Wait until orbax has written a checkpoint, and seal it by its checksums."""
    started.result()
    if jax.process_index() == 0:
        lines = [f"{_checksum(file)}  {file.relative_to(path).as_posix()}" for file in _files(path)]
        write_text(_checksums_file(path), "\n".join(lines) + "\n")


def _check(path):
    """Raises UserError where no checkpoint is, and DamagedError where its files aren't as they were written."""
    if not is_checkpoint(path):
        raise UserError(f"{path} is no checkpoint; expected a directory written by openjax.train")
    try:
        lines = _checksums_file(path).read_text(encoding="utf-8").splitlines()
        expected = {name: checksum for checksum, _, name in (line.partition("  ") for line in lines)}
        found = {file.relative_to(path).as_posix(): file for file in _files(path)}
        different = sorted(expected.keys() ^ found.keys())
        different += [
            name
            for name in sorted(expected.keys() & found.keys())
            if _checksum(found[name]) != expected[name]
        ]
    except (OSError, UnicodeDecodeError) as error:
        raise DamagedError(f"checkpoint {path} is damaged ({error})") from error
    if different or not expected:
        where = different[0] if different else _CHECKSUMS
        raise DamagedError(f"checkpoint {path} is damaged: {where[:80]} isn't as it was written")


def _files(path):
    return sorted(file for file in path.rglob("*") if file.is_file())


def _checksum(file):
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _checksums_file(path):
    return path.with_name(path.name + _CHECKSUMS)


def _remove(path):
    """Delete a checkpoint; its checksums go first, so that a half-deleted one is none."""
    _checksums_file(path).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)


def _default_sharding():
    return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def _start_save(path, carry, notes):
    arrays = {name: leaf for name, leaf in named_leaves(carry).items() if leaf.size}
    path.parent.mkdir(parents=True, exist_ok=True)
    return load_orbax().save_async(path.absolute(), arrays, custom_metadata=notes)


def _check_same_shapes(path, stored, wanted):
    reason = "it was written by other settings or another version"
    for name, leaf in wanted.items():
        if name not in stored:
            raise UserError(f"checkpoint {path} lacks {name}; {reason}")
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        expected = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
        shape = tuple(stored[name].shape)
        if shape != tuple(expected.shape) or stored[name].dtype != expected.dtype:
            raise UserError(
                f"checkpoint {path} is of another shape: {name} is {stored[name].dtype}{list(shape)} there, "
                f"the settings make it {expected.dtype}{list(expected.shape)}"
            )
    for name in stored:
        if name not in wanted:
            raise UserError(f"checkpoint {path} also holds {name}; {reason}")
