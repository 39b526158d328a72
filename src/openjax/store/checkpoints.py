"""Checkpoints of a whole training carry: atomic, exact, the last good one found again after any kill.

Orbax stands behind this module only. A carry is any pytree of arrays; optimiser states, typed random keys and
counters are leaves like all others, so nothing can be forgotten. Leaves are stored under their path in the
tree, which makes a carry of another shape a readable error instead of a wrong run.
"""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint.experimental import v1 as orbax

from openjax.cluster.processes import Processes
from openjax.errors import UserError

_DIGITS = 9


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
    if jax.process_index() == 0:
        shutil.rmtree(path, ignore_errors=True)
    _start_save(Path(path), carry, notes or {}).result()


def load_state(path: Path, abstract: Any) -> Any:
    """Read a carry whose shapes, dtypes and shardings are those of `abstract` (from `abstract_like`).

    Raises:
      UserError: not a checkpoint, or one of another shape.
    """
    path = Path(path).absolute()
    if not is_checkpoint(path):
        raise UserError(f"{path} is no checkpoint; expected a directory written by openjax.train")
    stored = orbax.metadata(path).metadata
    wanted = {name: leaf for name, leaf in named_leaves(abstract).items() if leaf.size}
    _check_same_shapes(path, stored, wanted)
    arrays = orbax.load(path, wanted)
    # Orbax can't write arrays without elements; they hold nothing, so they are made anew.
    leaves = [
        arrays[name] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype, device=leaf.sharding)
        for name, leaf in named_leaves(abstract).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(abstract), leaves)


def load_arrays(path: Path, prefix: str = "") -> dict[str, np.ndarray]:
    """Leaves by path as host arrays, without knowing the tree; only those whose path starts with `prefix`.

    Read by this process alone.
    """
    path = Path(path).absolute()
    if not is_checkpoint(path):
        raise UserError(f"{path} is no checkpoint; expected a directory written by openjax.train")
    sharding = _default_sharding()
    wanted = {
        name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
        if name.startswith(prefix)
        else orbax.PLACEHOLDER
        for name, leaf in orbax.metadata(path).metadata.items()
    }
    this = jax.process_index()
    alone = orbax.options.MultiprocessingOptions(primary_host=this, active_processes={this})
    with orbax.Context(multiprocessing_options=alone):
        loaded = {name: leaf for name, leaf in orbax.load(path, wanted).items() if name.startswith(prefix)}
    is_key = {name: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for name, leaf in loaded.items()}
    return {
        name: np.asarray(jax.random.key_data(leaf) if is_key[name] else leaf) for name, leaf in loaded.items()
    }


def is_checkpoint(path: Path) -> bool:
    """True for a committed checkpoint; half-written ones carry another name until they are whole."""
    return _metadata(Path(path)) is not None


class Checkpoints:
    """The checkpoints of one run: the last few and the best by validation are kept.

    Of several processes all write and read their part, in the same order; they share the directory.
    """

    def __init__(self, directory: Path, keep_last: int = 2, processes: Processes | None = None):
        self.directory = Path(directory).absolute()
        self.keep_last = keep_last
        self._processes = processes or Processes()
        self._pending = None
        self._known: dict[str, CheckpointRecord] = {}  # a committed checkpoint doesn't change

    def records(self) -> list[CheckpointRecord]:
        """Committed checkpoints, oldest first."""
        found = []
        for path in sorted(self.directory.glob("[0-9]" * _DIGITS)):
            metadata = None if path.name in self._known else _metadata(path)
            if metadata is not None:
                notes = dict(metadata.custom_metadata or {})
                self._known[path.name] = CheckpointRecord(
                    path, int(path.name), notes.pop("score", None), notes
                )
            if path.name in self._known:
                found.append(self._known[path.name])
        return found

    def best(self) -> CheckpointRecord | None:
        """The highest score, the later one of equals; None while nothing was evaluated."""
        scored = [record for record in self.records() if record.score is not None]
        return max(scored, key=lambda record: (record.score, record.update)) if scored else None

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
        if self._processes.of_first(is_checkpoint(path)):
            return
        if self._processes.is_first:
            shutil.rmtree(path, ignore_errors=True)
        self._pending = _start_save(path, carry, {**(notes or {}), "score": score})

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
                shutil.rmtree(record.path, ignore_errors=True)

    def restore_latest(self, abstract: Any, warn=lambda text: None) -> tuple[Any, CheckpointRecord]:
        """The newest checkpoint that can be read; damaged ones are passed over with a warning.

        Raises:
          UserError: there is none, or it holds a carry of another shape.
        """
        self.remove_unfinished()
        records = {record.path.name: record for record in self.records()}
        for name in reversed(self._processes.of_first(list(records))):
            path, failure, carry = self.directory / name, None, None
            try:
                carry = load_state(path, abstract)
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
        for path in self.directory.iterdir():
            if path.is_dir() and "tmp" in path.name:
                shutil.rmtree(path, ignore_errors=True)


def _metadata(path):
    """Orbax's metadata of a committed checkpoint, else None."""
    if not path.is_dir():
        return None
    try:
        return orbax.metadata(path.absolute())
    except Exception:  # whatever orbax and tensorstore make of a foreign or damaged directory: it's none
        return None


def _default_sharding():
    return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def _start_save(path, carry, notes):
    arrays = {name: leaf for name, leaf in named_leaves(carry).items() if leaf.size}
    path.parent.mkdir(parents=True, exist_ok=True)
    return orbax.save_async(path.absolute(), arrays, custom_metadata=notes)


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
