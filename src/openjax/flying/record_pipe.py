"""The messages of loop and links to the recorder, and the pipe that carries them.

Who tells never waits: what the pipe doesn't take is kept until the next record.
"""

import os
import struct
import threading
import time
from enum import IntEnum
from multiprocessing.connection import Connection

HEAD = struct.Struct("<iiI")
"""Of a record: its kind, a number, and the bytes that follow."""
REST = 0.05
"""s between two looks of the recorder into its pipes."""
_ATOM = 4096
"""A pipe takes so many bytes whole or not at all."""


class RecordKind(IntEnum):
    """The kind of a record; its number is a vehicle's or a game's."""

    POSES = 0
    BODIES = 1
    CAPTURE = 2
    TICK = 3
    GAME = 4
    BEGIN = 5
    END = 6


WIDTHS = {RecordKind.POSES: 16, RecordKind.BODIES: 11, RecordKind.CAPTURE: 14}
"""Numbers in a row of `Samples`."""
MEASURED = {RecordKind.POSES: 2, RecordKind.BODIES: 0, RecordKind.CAPTURE: 0}
"""Which of them is the time of the measurement."""


class Teller:
    """One process' end of a pipe to the recorder.

    Args:
      pipe: nobody is told where there is none.
      batch: bytes that wait until they are worth a call of the system.
    """

    def __init__(self, pipe: Connection | None, batch: int = 0):
        self._pipe = pipe
        self._batch = batch
        self._backlog = bytearray()
        self._lock = threading.Lock()
        if pipe is not None:
            os.set_blocking(pipe.fileno(), False)

    def row(self, kind: RecordKind, number: int, numbers) -> None:
        """Tell a row of numbers."""
        if self._pipe is not None:
            self.tell(kind, number, struct.pack(f"<{len(numbers)}d", *numbers))

    def tell(self, kind: RecordKind, number: int, data: bytes) -> None:
        """Tell a record."""
        if self._pipe is None:
            return
        with self._lock:
            self._backlog += HEAD.pack(kind, number, len(data)) + data
            if len(self._backlog) < self._batch:
                return
            try:
                while self._backlog:
                    count = os.write(self._pipe.fileno(), self._backlog[:_ATOM])
                    del self._backlog[:count]
            except BlockingIOError:
                return  # the pipe is full
            except OSError:
                self._pipe = None  # nobody listens any more
                self._backlog.clear()

    def tell_all(self, deadline: float) -> None:
        """Return once the pipe has taken everything, or at `deadline` (s)."""
        while self._backlog and time.monotonic() < deadline:
            time.sleep(REST)
            self.tell(RecordKind.END, 0, b"")
