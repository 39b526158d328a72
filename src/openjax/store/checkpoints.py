"""Checkpoints of a run: the last few and the best are kept, the last good one is found
again after any kill or damage.
"""

import dataclasses
import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from openjax.background import in_background
from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.files import WRITING
from openjax.store.checkpoint_files import (
    DamagedError,
    check_state,
    commit,
    is_checkpoint,
    load_arrays,
    load_orbax,
    load_state,
    remove_state,
    start_save,
)

_DIGITS = 9
"""Of an update in a checkpoint's name: names of one length are sorted as their numbers
are.
"""


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


class Checkpoints:
    """The checkpoints of one run: the last few and the best by validation are kept.

    Of several processes all write and read their part, in the same order; they share
    the directory.

    Args:
      directory: where they lie; made with the first of them.
      keep_last: how many of the newest are kept.
      processes: that share the directory; None: this one alone.
    """

    def __init__(self, directory: Path, keep_last: int = 2, processes: Processes | None = None):
        self.directory = Path(directory).absolute()
        self.keep_last = keep_last
        self._processes = processes or Processes()
        self._pending: Callable[[], None] | None = None
        # a finished checkpoint doesn't change
        self._known: dict[str, CheckpointRecord] = {}
        self._damaged: dict[str, str] = {}

    def records(self) -> list[CheckpointRecord]:
        """Finished and undamaged checkpoints, oldest first."""
        records = []
        for path in sorted(self.directory.glob("[0-9]" * _DIGITS)):
            if not is_checkpoint(path) or path.name in self._damaged:
                continue
            if path.name not in self._known:
                try:
                    self._known[path.name] = _record(path)
                except DamagedError as error:
                    self._damaged[path.name] = str(error)
                    continue
            records.append(self._known[path.name])
        return records

    def any_finished(self) -> bool:
        """True if there is a checkpoint, damaged or not."""
        return any(is_checkpoint(path) for path in self.directory.glob("[0-9]" * _DIGITS))

    def last_finished(self) -> int | None:
        """The update of the newest checkpoint, damaged or not; by the names of files
        alone, so that it may be asked at any time.
        """
        paths = self.directory.glob("[0-9]" * _DIGITS)
        return max((int(path.name) for path in paths if is_checkpoint(path)), default=None)

    def load_best(
        self, name_of: Callable[[str], str | None], warn: Callable[[str], None]
    ) -> tuple[dict[str, np.ndarray], CheckpointRecord]:
        """Leaves (see `load_arrays`) of the best checkpoint, or of the latest where
        none has a score.

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
        """The highest score, the later one of equals; None while nothing was
        evaluated.
        """
        records = [record for record in self.records() if record.score is not None]
        return max(records, key=lambda record: (record.score, record.update), default=None)

    def latest(self) -> CheckpointRecord | None:
        """The newest committed checkpoint."""
        records = self.records()
        return records[-1] if records else None

    def reach(self, update: int) -> bool:
        """True if the newest committed checkpoint is of this update, or a later one; the same
        for all processes.
        """
        latest = self.latest()
        return self._processes.of_first(latest is not None and latest.update >= update)

    def save(
        self, update: int, carry: Any, score: float | None = None, notes: dict | None = None
    ) -> None:
        """Start writing a checkpoint; returns when the arrays are copied, so that the
        carry may be donated.

        A second save of the same update is ignored: training is deterministic, the
        content would be the same. Only a score that the first one lacked is worth
        writing it again.
        """
        # one at a time: copies of two carries at once may not fit into memory
        self.wait()
        path = self.directory / f"{update:0{_DIGITS}d}"
        if self._processes.of_first(self._holds(path, score)):
            return
        if self._processes.is_first:
            remove_state(path)
            self._known.pop(path.name, None)
            self._damaged.pop(path.name, None)
        write = start_save(path, carry, {**(notes or {}), "score": score})
        self._pending = in_background(functools.partial(commit, path, write))

    def _holds(self, path, score):
        """True if a checkpoint is there, with a score if there is one to write."""
        if not is_checkpoint(path) or path.name in self._damaged:
            return False
        return score is None or any(
            record.path == path and record.score is not None for record in self.records()
        )

    def abandon(self) -> None:
        """Before the process is ended: let the checkpoint under way get on disk, and
        delete what else is unfinished.
        """
        pending = self._pending
        if pending is not None:
            pending()
        self.remove_unfinished()

    def wait(self) -> None:
        """Block until the checkpoint under way is on disk, then drop the ones that are
        no longer kept.
        """
        if self._pending is None:
            return
        pending = self._pending
        self._pending = None
        pending()
        if not self._processes.is_first:
            return
        records = self.records()
        best = self.best()
        # only now, when the newer one is whole on the disk
        for record in records[: -self.keep_last]:
            if best is None or record.path != best.path:
                remove_state(record.path)
                self._known.pop(record.path.name, None)

    def restore_latest(self, abstract: Any, warn=lambda text: None) -> tuple[Any, CheckpointRecord]:
        """The newest checkpoint that can be read; damaged ones are passed over with a
        warning.

        Raises:
          UserError: there is none, or it holds a carry of another shape.
        """
        self.remove_unfinished()
        records = {record.path.name: record for record in self.records()}
        for text in self._damaged.values():
            warn(f"{text}; using the one before it")
        for name in reversed(self._processes.of_first(list(records))):
            path = self.directory / name
            failure = None
            carry = None
            try:
                carry = load_state(path, abstract)
            except DamagedError:
                failure = "damaged"
            except UserError:
                raise
            except Exception as error:  # orbax and tensorstore raise many kinds on damaged files
                failure = type(error).__name__
            # where one process can't read its part, all go on to the one before
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


def _record(path):
    """The record of a checkpoint. Raises DamagedError."""
    check_state(path)
    try:
        notes = dict(load_orbax().metadata(path.absolute()).custom_metadata or {})
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise DamagedError(f"checkpoint {path} can't be read ({type(error).__name__})") from error
    return CheckpointRecord(path, int(path.name), notes.pop("score", None), notes)
