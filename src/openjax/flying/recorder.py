"""The recorder: a process that writes a flight's case while the vehicles fly, so that
what was flown is on the disk whatever becomes of the others.

Loop and links tell it what they know through a pipe each, and never wait for it. It
writes once a second, and the end of the flight once the loop says so, or both are gone.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import time
from array import array
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openjax.errors import UserError
from openjax.flying.board import say, stand_alone, start_deaf
from openjax.flying.flight_files import CaseFolder, GameLog, VehicleSamples
from openjax.flying.flight_record import FlightRecord
from openjax.flying.record_pipe import HEAD, MEASURED, REST, WIDTHS, RecordKind, Teller

EVERY = 1.0
"""s between two pieces of a log."""
HELD_BACK = 0.5
"""s that a row waits for what was measured at its moment and comes later: longer than a
link may be silent.
"""
STARTING = 30.0
"""s that its interpreter may take to load, on a busy machine."""
CLOSING = 20.0
"""s that the last piece may take, on a busy disk."""
CUT = "the loop's process ended before the flight"


class NewCase(NamedTuple):
    """The case that is to be written."""

    folder: Path
    files: dict[str, bytes]
    """Its content from the start, by name."""
    about: dict
    """Content of flight.json beside timing and games."""


class LogOutcome(NamedTuple):
    """The fate of a log."""

    folder: Path | None = None
    """None: there is no log."""
    longest: float = 0.0
    """Of its games (s)."""
    complaint: str = ""
    """Differences from what it should be, and from where."""


class Recorder:
    """The loop's end of the recorder's process.

    Args:
      case: to write; None: nothing is recorded.
      vehicles: their number.
    """

    def __init__(self, case: NewCase | None, vehicles: int):
        self._case = case
        self._process = None
        self._pipes: list[Connection] = []
        self.links_pipe: Connection | None = None
        pipe = None
        if case is not None:
            context = multiprocessing.get_context("spawn")
            loop, pipe = context.Pipe(duplex=False)
            links, self.links_pipe = context.Pipe(duplex=False)
            self._answer, answer = context.Pipe(duplex=False)
            self._pipes = [loop, links, answer]
            arguments = (case, vehicles, loop, links, answer)
            self._process = context.Process(target=keep, args=arguments, name="openjax recorder")
        self.teller = Teller(pipe)

    def start(self) -> None:
        """Start the process, once the links have their pipe, and return when it listens.
        UserError: it doesn't.
        """
        if self._process is None:
            return
        start_deaf(self._process)
        # where only its owner holds an end the others notice that it is gone
        for end in (*self._pipes, self.links_pipe):
            end.close()
        try:
            if self._answer.poll(STARTING):
                self._answer.recv()
                return
        except (EOFError, OSError):
            pass
        raise UserError("no take-off: the recorder's process doesn't start")

    def begin(self, scheduler: str) -> None:
        """A flight begins: from now on there is a folder."""
        self.teller.tell(RecordKind.BEGIN, 0, json.dumps({"scheduler": scheduler}).encode())

    def tell_tick(self, row: bytes) -> None:
        """See `FlightRecord`."""
        self.teller.tell(RecordKind.TICK, 0, row)

    def tell_game(self, number: int, notes: dict) -> None:
        """See `FlightRecord`."""
        self.teller.tell(RecordKind.GAME, number, json.dumps(notes).encode())

    def end(self, reasons: list[str]) -> LogOutcome:
        """The flight is over, for these reasons; what became of the log."""
        if self._process is None:
            return LogOutcome()
        deadline = time.monotonic() + CLOSING
        self.teller.tell(RecordKind.END, 0, json.dumps({"reasons": reasons}).encode())
        self.teller.tell_all(deadline)
        try:
            if self._answer.poll(max(deadline - time.monotonic(), 0.0)):
                return self._answer.recv()
            state = "doesn't answer"
        except (EOFError, OSError):
            state = "is gone"
        folder = self._case.folder
        complaint = f"the recorder's process {state}: {folder} holds what it had written by then"
        return LogOutcome(None, 0.0, complaint)

    def close(self) -> None:
        """End the process; it has written everything, or nothing flew."""
        if self._process is not None and self._process.pid is not None:
            self.teller = Teller(None)
            self._process.kill()
            self._process.join()


def keep(
    case: NewCase, vehicles: int, loop: Connection, links: Connection, answer: Connection
) -> None:
    """The recorder's process."""
    stand_alone()
    answer.send(None)  # it listens
    book = _Book(case, vehicles)
    pipes = [loop, links]
    rest = {loop: b"", links: b""}
    due = time.perf_counter() + EVERY
    over_at = np.inf
    while pipes:
        now = time.perf_counter()
        over_at = min(over_at, now if book.is_over else np.inf)
        # links that are gone tell nothing more, others may yet tell of the last ticks
        told_all = book.knows_all or links not in pipes or now > over_at + CLOSING / 2.0
        if book.is_over and told_all:
            break
        for pipe in wait(pipes, EVERY):
            data = os.read(pipe.fileno(), 1 << 20)
            rest[pipe] = book.take(rest[pipe] + data)
            if not data:
                pipes.remove(pipe)
        if time.perf_counter() >= due:
            due = time.perf_counter() + EVERY
            book.write(book.time - HELD_BACK)
        time.sleep(REST)
    outcome = book.close()
    if not book.is_over and outcome.folder is not None:
        say(f"openjax fly: {CUT}; {outcome.folder} holds the log of what was flown")
    with contextlib.suppress(OSError):
        answer.send(outcome)


class _Book:
    """The messages that the recorder got, and which of them are written."""

    def __init__(self, case: NewCase, vehicles: int):
        self._case = case
        self._about = dict(case.about)
        self._record = FlightRecord(vehicles)
        self._rows = {(kind, i): array("d") for kind in WIDTHS for i in range(vehicles)}
        self._notes: dict[int, dict] = {}
        self._logs: dict[int, GameLog] = {}
        self._case_folder: CaseFolder | None = None
        self._vehicles = vehicles
        self._newest = {"loop": -np.inf, "links": -np.inf}
        self.is_over = False

    @property
    def knows_all(self) -> bool:
        """True if the links have told all up to the loop's last tick."""
        return self._newest["links"] >= self._newest["loop"]

    @property
    def time(self) -> float:
        """The moment (s) of which both loop and links have told: on a busy machine what
        they tell is read late.
        """
        return min(self._newest.values())

    def take(self, data: bytes) -> bytes:
        """Take in the records of these bytes; what is left of the last, incomplete one."""
        at = 0
        while len(data) - at >= HEAD.size:
            kind, number, size = HEAD.unpack_from(data, at)
            if len(data) - at < HEAD.size + size:
                break
            at += HEAD.size
            self._take_one(RecordKind(kind), number, data[at : at + size])
            at += size
        return data[at:]

    def _take_one(self, kind: RecordKind, number: int, data: bytes) -> None:
        if kind in WIDTHS:
            rows = self._rows[kind, number]
            rows.frombytes(data)
            if kind is not RecordKind.CAPTURE:
                self._newest["links"] = rows[MEASURED[kind] - WIDTHS[kind]]
        elif kind is RecordKind.TICK:
            self._record.add(data)
            self._newest["loop"] = array("d", data)[1]
        elif kind is RecordKind.GAME:
            self._notes[number] = json.loads(data)
            self._logs.setdefault(number, GameLog(number))
        elif data:
            self._about |= json.loads(data)
            self.is_over = kind is RecordKind.END
        if kind is RecordKind.BEGIN:
            self._case_folder = CaseFolder(self._case.folder)
            for name, content in self._case.files.items():
                self._case_folder.put(name, content)
            self._write_about({})

    def write(self, until: float) -> None:
        """Write the rows up to a moment (s)."""
        if self._case_folder is None:
            return
        ticks, vehicles = self._record.table()
        samples = [self._samples(i) for i in range(self._vehicles)]
        for number, log in list(self._logs.items()):
            of_game = ticks[:, 2] == number
            if of_game.any():
                sent_at = ticks[of_game, 1]
                piece = log.piece(samples, sent_at, vehicles[of_game, :, 2:], until)
                if piece:
                    self._case_folder.extend(log.name, piece)
                if self._notes[number]["end"] and until > sent_at[-1]:
                    del self._logs[number]
        # a row's time is rounded when it is written
        self._forget(until - REST)

    def _samples(self, i: int) -> VehicleSamples:
        """The samples of vehicle i that are still kept."""
        poses, bodies, captures = (
            np.array(self._rows[kind, i]).reshape(-1, width) for kind, width in WIDTHS.items()
        )
        return VehicleSamples(poses, bodies, captures)

    def _forget(self, moment: float) -> None:
        """Forget the rows that were measured before a moment (s)."""
        for (kind, i), rows in self._rows.items():
            table = np.array(rows).reshape(-1, WIDTHS[kind])
            recent = table[table[:, MEASURED[kind]] >= moment]
            self._rows[kind, i] = array("d", recent.tobytes())

    def _write_about(self, more: dict) -> None:
        games = [self._notes[number] for number in sorted(self._notes)]
        text = json.dumps({**self._about, **more, "games": games}, indent=1)
        self._case_folder.put("flight.json", (text + "\n").encode())

    def close(self) -> LogOutcome:
        """Write the rest; what became of the log."""
        if self._case_folder is None:
            return LogOutcome()
        self.write(np.inf)
        if not self.is_over:
            self._about["reasons"] = [CUT] * self._vehicles
        self._write_about({"timing": self._record.timing()})
        folder = self._case_folder
        complaint = ""
        if folder.refusal and folder.complete:
            complaint = f"{folder.refusal}; the log is in {folder.folder}"
        elif folder.refusal:
            complaint = f"{folder.refusal}: no log, or a part of it"
        is_there = folder.folder.is_dir()
        return LogOutcome(folder.folder if is_there else None, self._longest(), complaint)

    def _longest(self) -> float:
        """s of the longest game."""
        ticks, _ = self._record.table()
        lengths = [np.ptp(ticks[ticks[:, 2] == number, 1]) for number in self._notes]
        return float(max(lengths, default=0.0))
