"""The files that a flight leaves behind: a case that `openjax diagnose` reads, and `flight.json`
about the flight.

One log per game, with all vehicles in it: a row for each moment at which something was sampled on
board. Commands are those in force at that moment, as sent: body rates and thrust. A log grows while
its game is flown; each piece is a gzip member of its own, so what is there can be read.
"""

import contextlib
import gzip
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openjax.files import replacing
from openjax.flights.csv_table import csv_rows
from openjax.flights.reading import CHANNEL_COLUMNS, LOG_COLUMNS, LogTable
from openjax.flying.set_point import RATES

BYTES_PER_SECOND = 90_000
"""What a second of one vehicle takes at most, unpacked, with five log blocks of motors."""
LONGEST = 900.0
"""No battery of such a vehicle lasts longer (s)."""
DECIMALS = {"t": 4, "vbat": 3}  # others have six
_POSE = (
    *CHANNEL_COLUMNS["position"],
    *CHANNEL_COLUMNS["velocity"],
    *CHANNEL_COLUMNS["quaternion"],
    *CHANNEL_COLUMNS["body_rates"],
)
"""Of a `Pose`'s 13 numbers, in their order."""
_BODY = (
    *CHANNEL_COLUMNS["motor_command"],
    *CHANNEL_COLUMNS["specific_force"],
    *CHANNEL_COLUMNS["body_rates"],
)
_COMMAND = CHANNEL_COLUMNS["command_thrust"] + CHANNEL_COLUMNS["command_body_rates"]
_READINGS = (*_POSE, *_BODY, *_COMMAND, "vbat")
COLUMNS = tuple(n for n in LOG_COLUMNS if n in ("t", "vehicle", *_READINGS))


def bytes_needed(vehicles: int, seconds: float) -> int:
    """Room that the log of a flight takes at most."""
    return int(vehicles * min(seconds, LONGEST) * BYTES_PER_SECOND)


class CaseFolder:
    """The files of a case. Where a disk refuses one they move to the next place that
    takes it; where none does, what is written by then stays.

    Args:
      folder: where the case is to be.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        """Its place."""
        self.refusal = ""
        """The reason why the first place was refused."""
        self.complete = True
        """True if everything was written, here or there."""
        name = f"openjax-{folder.absolute().name}-{os.getpid()}"
        self._others = [
            place / name
            for place in (Path(tempfile.gettempdir()), Path.home(), Path("/dev/shm"))
            if place.is_dir()
        ]
        self._try(lambda folder: folder.mkdir(parents=True, exist_ok=True))

    def put(self, name: str, data: bytes) -> None:
        """Write a file in one piece, in the place of an older one."""

        def write(folder):
            with replacing(folder / name) as partial:
                partial.write_bytes(data)

        self._try(write)

    def extend(self, name: str, data: bytes) -> None:
        """Add a piece to a file, the whole of it or nothing."""

        def write(folder):
            with (folder / name).open("ab", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                try:
                    if file.write(data) != len(data):
                        raise OSError(28, "no space left on the device")
                    os.fsync(file.fileno())
                except OSError:
                    with contextlib.suppress(OSError):
                        file.truncate(size)
                    raise

        self._try(write)

    def _try(self, write: Callable[[Path], None]) -> None:
        try:
            write(self.folder)
        except OSError as error:
            self.refusal = self.refusal or f"{self.folder}: {error.strerror or error}"
            # a disk that was full once may take what is small
            self.complete = self.complete and any(self._moves(to, write) for to in self._others)

    def _moves(self, place: Path, write: Callable[[Path], None]) -> bool:
        """True if all that there is moved to this place, which takes one thing more."""
        try:
            if self.folder.is_dir():
                shutil.copytree(self.folder, place)
            write(place)
        except OSError:
            shutil.rmtree(place, ignore_errors=True)
            return False
        shutil.rmtree(self.folder, ignore_errors=True)
        self._others.remove(place)
        self.folder = place
        return True


@dataclass(frozen=True)
class VehicleSamples:
    """The recorded samples of one vehicle; times are host seconds. NumPy."""

    poses: np.ndarray
    """(K, 16) own estimates: arrival, voltage (V), when measured, position, velocity,
    quaternion, body rates.
    """
    bodies: np.ndarray
    """(K, 11): when measured, m1..m4 0..1, the specific force (m/s^2), body rates."""
    seen: np.ndarray
    """(K, 14) by motion capture, where there is one: when measured, position, velocity,
    quaternion, body rates.
    """


class GameLog:
    """The log of one game, piece by piece.

    Args:
      number: of the game.
    """

    def __init__(self, number: int):
        self.name = f"game_{number:02d}.csv.gz"
        self._until = -np.inf

    def piece(
        self,
        samples: Sequence[VehicleSamples],
        sent_at: np.ndarray,
        commands: np.ndarray,
        until: float,
    ) -> bytes:
        """The rows after the last piece and up to `until` (s), packed; empty where there are none.

        Args:
          samples: what was recorded of each vehicle.
          sent_at: (T,) s, when the set-points of each tick had left.
          commands: (T, N, 5) of them: mode, thrust, body rates.
        """
        first = self._until == -np.inf
        # times as the log writes them: a row mustn't be in two pieces
        begin = np.nextafter(sent_at[0], -np.inf) if first else self._until
        until = min(until, sent_at[-1])
        if until <= begin:
            return b""
        self._until = until
        window = (begin, until)
        rows = [_rows(v, sent_at, commands[:, i], window) for i, v in enumerate(samples)]
        ids = np.concatenate([np.full(len(r["t"]), str(i)) for i, r in enumerate(rows)])
        # stable: rows of one moment stay in the vehicles' order
        order = np.argsort(np.concatenate([r["t"] for r in rows]), kind="stable")
        columns = {n: np.concatenate([r[n] for r in rows])[order] for n in rows[0]}
        text = csv_rows(LogTable(self.name, columns, ids[order]), COLUMNS, DECIMALS)
        header = f"{','.join(COLUMNS)}\n" if first else ""
        return gzip.compress((header + text).encode(), 6, mtime=0) if header or text else b""


class _Source(NamedTuple):
    """The samples of one sensor or log block."""

    time: np.ndarray
    """(K,) s"""
    names: tuple[str, ...]
    """Columns."""
    values: np.ndarray
    """(K, columns)"""

    def during(self, window) -> "_Source":
        """The measurements after the first and up to the last moment (s) of a window, with times as
        a log writes them.
        """
        time = np.round(self.time, DECIMALS["t"])
        inside = (time > window[0]) & (time <= window[1])
        return _Source(time[inside], self.names, self.values[inside])


def _sources(vehicle: VehicleSamples) -> list[_Source]:
    """All that was recorded of a vehicle; what comes later replaces what came before."""
    own_poses = np.column_stack([vehicle.poses[:, 3:], vehicle.poses[:, 1]])
    poses = _Source(vehicle.poses[:, 2], (*_POSE, "vbat"), own_poses)
    bodies = _Source(vehicle.bodies[:, 0], _BODY, vehicle.bodies[:, 1:])
    if not len(vehicle.seen):
        return [poses, bodies]
    # motion capture in place of the estimate on board, of which body rates and voltage stay
    poses = _Source(poses.time, poses.names[10:], own_poses[:, 10:])
    capture = _Source(vehicle.seen[:, 0], _POSE[:10], vehicle.seen[:, 1:11])
    return [poses, bodies, capture]


def _rows(vehicle: VehicleSamples, sent_at, commands, window) -> dict[str, np.ndarray]:
    """The rows of one vehicle in a window of time, by column: one for each moment at
    which something was measured.
    """
    sources = [source.during(window) for source in _sources(vehicle)]
    times = np.unique(np.concatenate([source.time for source in sources]))
    rows = {n: np.full(len(times), np.nan) for n in ("t", *_READINGS)}
    rows["t"] = times - sent_at[0]
    for source in sources:
        at = np.searchsorted(times, source.time)
        for n, column in zip(source.names, source.values.T, strict=True):
            rows[n][at] = column
    # in force at a moment is what left last before it
    command = commands[np.maximum(np.searchsorted(sent_at, times, side="right") - 1, 0)]
    # angles and motors off are no commanded body rates: their cells stay empty
    is_rates = command[:, 0] == RATES
    for n, column in zip(_COMMAND, command[:, 1:].T, strict=True):
        rows[n][is_rates] = column[is_rates]
    return rows
