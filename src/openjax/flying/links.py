"""The vehicles' links in a process of their own (`openjax.flying.links_process`), so
that `cflib`'s threads never keep the loop waiting: the loop's end of them.

`cflib` has two Python threads per vehicle. In one interpreter with the loop they take
it from each other, for milliseconds in one tick of a hundred. Here poses come up as
they arrive, a record each; set-points go down, a datagram for all vehicles, which is
answered with the time at which the last one had left. What is sampled on board goes to
the recorder. Everything else, as arming, is a call over a pipe.
"""

import contextlib
import math
import multiprocessing
import os
import select
import socket
import threading
import time
from collections.abc import Sequence

from openjax.errors import UserError
from openjax.flying.board import SILENCE, Board, Role, start_deaf
from openjax.flying.controller import Pose, pose_of
from openjax.flying.links_process import (
    POSE_RECORD,
    SENT_RECORD,
    SET_POINT_RECORD,
    SET_POINTS_NUMBER,
    Connection,
    Ends,
    serve,
)
from openjax.flying.set_point import SetPoint
from openjax.flying.state import PoseSample, State

STARTING = 20.0
"""s until its interpreter has loaded `cflib`, on a busy machine."""
CLOSING = 2.0
"""s that it has to disarm."""


class LinksGone(UserError):
    """The links' process ended, hangs, or flies by itself."""


class Links:
    """Crazyflies, real or virtual, over links in another process; to the loop what it flies.

    Args:
      uris, body_logs, watchdog: as of `openjax.flying.swarm.Swarm`.
      state: before the flight, from which the links' process lands all if the loop
      stops; without it nobody does.
      silence: of the loop, after which it does (s). If the links' process doesn't pass
      on set-points for half as long again it is taken for dead: vehicles go on turning
      as they were told last.
    """

    def __init__(
        self,
        uris: Sequence[str],
        body_logs: int = 1,
        watchdog: bool = True,
        state: State | None = None,
        silence: float = SILENCE,
    ):
        self._uris = tuple(uris)
        self._body_logs = body_logs
        self._watchdog = watchdog
        self._state = state
        n = len(self._uris)
        # a forked process would hold locks of JAX's threads that nobody gives back
        self._context = multiprocessing.get_context("spawn")
        self.board = Board(n, self._context, silence)
        self._samples = [PoseSample(None, -math.inf, supervisor=0)] * n
        self._arrivals = [-math.inf] * n
        self.counts = [0] * n
        """Poses of each vehicle that have arrived."""
        self._rest = b""
        self._count = 0
        self._calls = 0
        self._process = None
        self._lock = threading.Lock()
        self._blocks: tuple[int, ...] = ()

    def connect(self, timeout: float = 20.0, log=None) -> None:
        """Open all links and start the log blocks.

        Args:
          timeout: for each vehicle (s).
          log: a pipe to the recorder, if there is one.

        Raises:
          UserError: cflib isn't there, a vehicle doesn't answer, or lacks a variable.
        """
        context = self._context
        self._contacts = context.RawArray("d", [time.perf_counter()] * len(self._uris))
        # poses come one after the other; a tick's set-points are one datagram, whole or not there
        self._stream, stream = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._control, control = context.Pipe()
        self._stream.setblocking(False)
        # who is silent for longer than that isn't the pilot any more
        self._commands.settimeout(1.5 * self.board.silence)
        connection = Connection(self._uris, self._body_logs, self._watchdog, timeout)
        ends = Ends(self._contacts, stream, commands, control, log)
        arguments = (connection, ends, self.board, os.getpid(), self._state)
        self._process = context.Process(target=serve, args=arguments, name="openjax links")
        start_deaf(self._process)
        for end in (stream, commands, control):
            end.close()
        complaint = "the links' process doesn't answer"
        try:
            # vehicles are connected one after the other
            if self._control.poll(STARTING + timeout * (1 + len(self._uris))):
                complaint, self._blocks = self._control.recv()
        except (EOFError, OSError):
            complaint = "the links' process ended before it had connected"
        except BaseException:  # Ctrl-C
            self.kill()
            raise
        if complaint is not None:
            self.kill()
            raise UserError(complaint)

    def kill(self) -> None:
        """End the links' process at once."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None

    def _call(self, name: str, *arguments, timeout: float = 30.0):
        """The result of a method of the swarm over there. UserError: there is no answer."""
        try:
            with self._lock:
                self._calls += 1
                number = self._calls
                self._control.send((number, name, arguments))
            answer = 0
            while answer != number:  # answers of interrupted calls may still be there
                if not self._control.poll(timeout):
                    raise LinksGone("the links' process is stuck")
                answer, result = self._control.recv()
        except (EOFError, OSError) as error:
            raise LinksGone("the links' process is gone") from error
        return result

    def _drain(self) -> None:
        """Take in the poses that have arrived."""
        while True:
            try:
                data = self._stream.recv(1 << 16)
            except (BlockingIOError, ConnectionError):
                return
            if not data:
                return
            # a stream keeps no records apart: the last one may have come in part
            data = self._rest + data
            complete = len(data) - len(data) % POSE_RECORD.size
            self._rest = data[complete:]
            for vehicle, supervisor, arrival, voltage, *numbers in POSE_RECORD.iter_unpack(
                data[:complete]
            ):
                force = tuple(numbers[:3])
                self._samples[vehicle] = PoseSample(
                    own=pose_of(numbers[3:]),
                    last_contact=arrival,
                    voltage=voltage,
                    supervisor=supervisor,
                    force=None if math.isnan(sum(force)) else force,
                )
                self._arrivals[vehicle] = arrival
                self.counts[vehicle] += 1

    def wait(self, until: float) -> None:
        """Return at `until` (s), or as soon as a pose arrives."""
        seconds_left = until - time.perf_counter()
        if seconds_left > 0:
            select.select([self._stream], [], [], seconds_left)

    def observe(self) -> tuple[PoseSample, ...]:
        """The latest samples of each vehicle."""
        self._drain()
        samples = zip(self._samples, self._contacts, strict=True)
        return tuple(sample._replace(last_contact=contact) for sample, contact in samples)

    def arrivals(self) -> tuple[float, ...]:
        """The time at which each vehicle's newest pose arrived (s, host)."""
        self._drain()
        return tuple(self._arrivals)

    def send(self, set_points: Sequence[SetPoint]) -> float:
        """Send each vehicle its set-point; returns when the last one left (s).

        Raises:
          LinksGone: the links' process is gone or stuck, or flies by itself.
        """
        if self.board.pilot is not Role.LOOP:
            raise LinksGone("another process flies")
        self._count += 1
        payload = b"".join(SET_POINT_RECORD.pack(*s) for s in set_points)
        try:
            self._commands.send(SET_POINTS_NUMBER.pack(self._count) + payload)
            number = 0
            # an answer that came too late for its tick may still be there
            while number != self._count:
                number, sent_at = SENT_RECORD.unpack(self._commands.recv(SENT_RECORD.size))
        except OSError as error:
            raise LinksGone("the links' process is gone or stuck") from error
        return sent_at

    def send_pose(self, i: int, pose: Pose) -> None:
        """Tell vehicle i where motion capture sees it."""
        with self._lock:
            self._control.send((0, "send_pose", (i, pose.position, pose.quaternion)))

    def believed(self, vehicle: int, pose: Pose, feeds_estimator: bool) -> None:
        """There is no motion capture here."""

    def arm(self) -> None:
        """Arm all."""
        self.board.armed = True
        self._call("arm", True)

    def disarm(self) -> bool:
        """Motors off, and disarm all; whether all said that they are."""
        return self._call("disarm")

    def pose_blocks(self) -> tuple[int, ...]:
        """The id of each vehicle's pose block."""
        return self._blocks

    def close(self) -> None:
        """Motors off, disarmed, links closed."""
        if self._process is None:
            return
        with contextlib.suppress(UserError):
            self._call("close", timeout=CLOSING)
        self._process.join(CLOSING)
        self.kill()
        for end in (self._stream, self._commands, self._control):
            end.close()
