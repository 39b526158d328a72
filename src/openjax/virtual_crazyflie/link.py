"""The link of a virtual Crazyflie: UDP, one packet a datagram, with latency, jitter and
loss to order.
"""

import contextlib
import heapq
import math
import random
import socket
from dataclasses import dataclass
from typing import Annotated

from openjax.errors import UserError
from openjax.flying.crtp import Port
from openjax.ranges import Interval, Seed, check_intervals
from openjax.virtual_crazyflie.firmware import STEP


@dataclass(frozen=True)
class LinkFaults:
    """Faults of the link in the two streams of a flight. Requests and their answers pass: a radio
    sends them again.
    """

    latency_ms: Annotated[float, Interval("[0, 1000]")] = 0.0
    """Set-points arrive this much later (ms)."""
    jitter_ms: Annotated[float, Interval("[0, 1000]")] = 0.0
    """Set-points arrive up to this much later than that, drawn for each (ms)."""
    loss: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the set-points that never arrive."""
    pose_latency_ms: Annotated[float, Interval("[0, 1000]")] = 0.0
    """Log data arrive this much later (ms)."""
    pose_loss: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the log data that never arrive."""
    seed: Seed = 0
    """Draws losses and jitter."""

    def __post_init__(self):
        check_intervals(self, "--")


class VirtualLink:
    """The socket of vehicle `i`. Times are those of the caller's clock, in seconds."""

    def __init__(self, host: str, port: int, faults: LinkFaults, i: int):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((host, port))
        # taken, beyond 65535, no name of a host
        except (OSError, OverflowError, UnicodeError) as error:
            self.socket.close()
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"UDP port {port} of {host} can't be opened ({reason}); choose another --port"
            ) from error
        self.socket.setblocking(False)
        self.faults = faults
        # vehicles lose packets of their own, and seeds don't meet each other's vehicles
        self._random = random.Random(1000 * faults.seed + i)
        self._listener = None
        self._incoming: list = []
        self._outgoing: list = []
        self._count = 0

    @property
    def port(self) -> int:
        """Its UDP port."""
        return self.socket.getsockname()[1]

    def poll(self, time: float) -> None:
        """Take in what has arrived at the socket."""
        while True:
            try:
                raw, peer = self.socket.recvfrom(64)
            except BlockingIOError:
                return
            except ConnectionError:  # a peer that has gone
                continue
            if not raw:
                continue
            delay = 0.0
            is_command = raw[0] >> 4 in (Port.COMMANDER, Port.COMMANDER_GENERIC)
            if is_command or raw[0] >> 4 == Port.LOG or self._listener is None:
                self._listener = peer
            if is_command:
                if self._random.random() < self.faults.loss:
                    continue
                jitter = self._random.random() * self.faults.jitter_ms
                delay = 1e-3 * (self.faults.latency_ms + jitter)
            # the firmware looks for packets at its steps, never before they came
            due = STEP * math.ceil((time + delay) / STEP - 1e-6)
            # the count keeps packets of one moment in order, and heaps from comparing
            # peers
            self._count += 1
            heapq.heappush(self._incoming, (due, self._count, raw, peer))

    def next_due(self) -> float:
        """The time at which the next packet in either direction is due; infinite if none waits."""
        waiting = [queue[0][0] for queue in (self._incoming, self._outgoing) if queue]
        return min(waiting, default=float("inf"))

    def received(self, time: float):
        """The packets that have come through by `time`, in order: time, bytes, who sent
        them.
        """
        while self._incoming and self._incoming[0][0] <= time:
            due, _, raw, peer = heapq.heappop(self._incoming)
            yield due, raw, peer

    def send(self, raw: bytes, time: float, peer=None) -> None:
        """Send an answer to who asked, log data to who set up log blocks or commanded
        last: a stranger gets none.
        """
        log_data = raw[0] >> 4 == Port.LOG and raw[0] & 3 == 2
        if log_data and self._random.random() < self.faults.pose_loss:
            return
        self._count += 1
        delay = 1e-3 * self.faults.pose_latency_ms if log_data else 0.0
        heapq.heappush(self._outgoing, (time + delay, self._count, raw, peer or self._listener))

    def flush(self, time: float) -> None:
        """Put on the wire what is due."""
        while self._outgoing and self._outgoing[0][0] <= time:
            _, _, raw, peer = heapq.heappop(self._outgoing)
            if peer is not None:
                with contextlib.suppress(OSError):  # nobody listens there any more
                    self.socket.sendto(raw, peer)

    def close(self) -> None:
        """Give the port back."""
        self.socket.close()
