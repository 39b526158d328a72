"""Metrics as JSON lines and TensorBoard events; what was logged survives a SIGKILL."""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from openjax.files import replacing

METRICS_FILE = "metrics.jsonl"


class Continuation(NamedTuple):
    """The point from which a run continues. Records of later updates are removed, as they come
    again.
    """

    update: int
    steps: int = 0
    """Environment steps done by then, where TensorBoard's curves go on."""
    drop_validation: bool = False
    """True if the validation of this update comes again, too."""


class MetricsWriter:
    """Appends records to `DIR/metrics.jsonl` and `DIR/tensorboard`.

    Each record is one write to an unbuffered file, so nothing logged is lost with the
    process, and nothing is kept in memory.

    Args:
      directory: the run's directory.
      continuation: None starts afresh.
      tensorboard: False leaves the event files out.
      on_record: called with each record after it is written.
    """

    def __init__(
        self,
        directory: Path,
        continuation: Continuation | None = None,
        tensorboard: bool = True,
        on_record: Callable[[dict], Any] | None = None,
    ):
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / METRICS_FILE
        if continuation is None:
            path.unlink(missing_ok=True)
            shutil.rmtree(directory / "tensorboard", ignore_errors=True)
        else:
            truncate_metrics(path, continuation)
        self._file = open(path, "ab", buffering=0)
        self._on_record = on_record
        self._events = None
        if tensorboard:
            from tensorboardX import SummaryWriter

            # has TensorBoard forget what a killed process logged after its last
            # checkpoint
            purge_step = None if continuation is None else continuation.steps + 1
            self._events = SummaryWriter(
                str(directory / "tensorboard"), purge_step=purge_step, flush_secs=10
            )

    def write(
        self, event: str, update: int, steps: int, seconds: float, values: dict[str, float]
    ) -> None:
        """Log one record.

        Args:
          event: what it's about: `train` or `validation`; the prefix of the TensorBoard
          tags.
          update: training updates done.
          steps: environment steps done.
          seconds: training time so far, without the time between a kill and its resume.
          values: numbers by name; what isn't finite is written as null.
        """
        numbers = {name: float(value) for name, value in values.items()}
        record = {
            "event": event,
            "update": int(update),
            "steps": int(steps),
            "seconds": round(seconds, 3),
        }
        record |= {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        self._file.write((json.dumps(record) + "\n").encode())
        if self._events is not None:
            for name, value in numbers.items():
                # what isn't measured, as a prediction where nothing predicts, is no point
                if math.isfinite(value):
                    self._events.add_scalar(f"{event}/{name}", value, int(steps))
            self._events.flush()
        if self._on_record is not None:
            self._on_record(record)

    def close(self) -> None:
        """Close both files."""
        self._file.close()
        if self._events is not None:
            self._events.close()


def read_metrics(path: Path, event: str | None = None) -> Iterator[dict]:
    """Records of a metrics file, optionally of one event only; a half-written last line
    is passed over.
    """
    with open(path, "rb") as lines:
        for line in lines:
            try:
                record = json.loads(line)
            except ValueError:  # a kill cut the line
                continue
            if event is None or record["event"] == event:
                yield record


def truncate_metrics(path: Path, continuation: Continuation) -> None:
    """Drop the records that come again, and a half-written last line."""
    path = Path(path)
    if not path.exists():
        return

    def comes_again(record):
        if record["update"] == continuation.update:
            return continuation.drop_validation and record["event"] == "validation"
        return record["update"] > continuation.update

    with replacing(path) as partial, open(partial, "w", encoding="utf-8") as file:
        for record in read_metrics(path):
            if not comes_again(record):
                file.write(json.dumps(record) + "\n")
