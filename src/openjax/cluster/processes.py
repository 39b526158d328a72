"""The processes of a job that trains on several hosts: what all of them know, and the
loss of one.

Arrays travel by JAX's own collectives. Beside these every process holds one TCP
connection to process 0. Over it the processes agree on what only one of them knows (a
signal, a clock, a score), and by it they notice a process that is gone. JAX's heartbeat
(0.10) ends the others by a stack trace without a word of who was lost, whether or not
it may recover, and its collectives time out while process 0 compiles or draws for
minutes: so both are done here.
"""

import contextlib
import json
import os
import queue
import socket
import sys
import threading
from typing import Any, BinaryIO, NamedTuple

BEAT = 2.0
"""Seconds between two signs of life."""
SILENCE = 30.0
"""Seconds without one after which a process counts as lost."""
GRACE = 5.0
"""Seconds that a process has to end by itself when another one failed."""


class Peer(NamedTuple):
    """Another process, and the open connection to it."""

    socket: socket.socket
    reader: BinaryIO
    """The data that come from there."""
    host: str
    """The host of that process."""


class Processes:
    """This process among all of its job. One alone has no connections and loses nobody.

    Attributes:
      number, index: how many there are, and which one this is.
      advice: says what to do now, when another process is lost.
    """

    def __init__(self, number: int = 1, index: int = 0, connections: dict[int, Peer] | None = None):
        """`connections` by process: to all others on process 0, to process 0
        elsewhere.
        """
        self.number = number
        self.index = index
        self.advice = "start it again"
        self._links = {
            other: _Link(self, other, connection)
            for other, connection in (connections or {}).items()
        }
        self._asked = {other: queue.Queue() for other in self._links}
        self._answers: queue.Queue = queue.Queue()
        self._ending = threading.Lock()  # taken once, by what ends this process first
        for link in self._links.values():
            link.start()

    @property
    def is_first(self) -> bool:
        """True in the process that writes and shows."""
        return self.index == 0

    def everyone(self, value: Any = None) -> list:
        """The values (JSON) of all processes in their order; waits until all have come
        here.
        """
        if not self._links:
            return [value]
        if not self.is_first:
            self._links[0].send({"value": value})
            return self._answers.get()
        values = [value] + [self._asked[other].get() for other in sorted(self._asked)]
        self._send_all({"values": values})
        return values

    def of_first(self, value: Any = None) -> Any:
        """Process 0's value (JSON)."""
        return self.everyone(value if self.is_first else None)[0]

    def leave(self) -> None:
        """End in good order, together with all others."""
        self.everyone()
        self._send_all({"leaves": True})
        for link in self._links.values():
            link.close(GRACE)

    def fail(self, status: int, text: str) -> None:
        """Tell the others that this process ends with an exit status, and why; they end
        too.
        """
        # from here on no other process' end changes this one's
        self._ending.acquire(blocking=False)
        # what all did wrong, each reports by itself in the meantime
        self._send_all(
            {"error": f"process {self.index} ended: {text}", "status": status, "after": GRACE}
        )
        for link in self._links.values():
            link.close(2 * GRACE)

    def await_verdict(self) -> None:
        """After an error that a lost process may have caused: time for that news, which
        ends this process.
        """
        threading.Event().wait(GRACE if self._links else 0.0)

    def receive(self, other: int, message: dict) -> None:
        """Receive what another process sent."""
        if "value" in message:
            self._asked[other].put(message["value"])
        elif "values" in message:
            self._answers.put(message["values"])
        elif "error" in message:
            self.end(other, message)

    def end(self, source: int, message: dict) -> None:
        """Pass on what went wrong, say it and end: the main thread may wait for the
        lost process for ever.
        """
        if not self._ending.acquire(blocking=False):
            return
        if self.is_first:
            self._send_all(message, but=source)
        timer = threading.Timer(message["after"], _exit, (message["status"], message["error"]))
        timer.daemon = True
        timer.start()

    def _send_all(self, message, but=None):
        for other, link in self._links.items():
            if other != but:
                link.send(message)


class _Link:
    """A connection to another process: lines of JSON, and signs of life in both
    directions.
    """

    def __init__(self, job: Processes, other: int, connection: Peer):
        self._job = job
        self._other = other
        self._host = connection.host
        self._socket = connection.socket
        self._reader = connection.reader
        self._sending = threading.Lock()
        self._closed = threading.Event()
        self._socket.settimeout(SILENCE)
        # a message is a line: to wait for more to send with it would only delay it
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def start(self) -> None:
        for target in (self._read, self._beat):
            threading.Thread(target=target, name=f"process {self._other}", daemon=True).start()

    def send(self, message: dict) -> None:
        # what is wrong, the reader sees
        with contextlib.suppress(OSError), self._sending:
            self._socket.sendall(encode(message))

    def close(self, seconds: float) -> None:
        """No more from here; wait until the other side closes too."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
        self._closed.wait(seconds)

    def _read(self):
        # a thread that reads as long as the connection lives; how it ends says why
        reason = "its connection closed"
        leaves = False
        try:
            for line in self._reader:
                message = json.loads(line)
                leaves = leaves or "leaves" in message
                self._job.receive(self._other, message)
        except TimeoutError:
            reason = f"no sign of life for {SILENCE:.0f} s"
        except OSError as error:
            reason = f"its connection broke ({error.strerror or error})"
        except ValueError:
            reason = "it sent half a message"
        self._closed.set()
        if not leaves:
            job = self._job
            who = f"process {self._other} of {job.number} (on {self._host})"
            error = f"{who} was lost: {reason}; {job.advice}"
            job.end(self._other, {"error": error, "status": 1, "after": 0.0})

    def _beat(self):
        while not self._closed.wait(BEAT):
            self.send({})


def _exit(status, error):
    # a live display hides it
    show_cursor = "\x1b[?25h\n" if sys.stdout.isatty() else ""
    # past Python's own end, which would wait for the main thread
    os.write(2, f"{show_cursor}error: {error}\n".encode())
    os._exit(status)


def encode(message: dict) -> bytes:
    """A message as it goes over a connection."""
    return (json.dumps(message) + "\n").encode()
