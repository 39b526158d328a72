"""The vehicles' links in a process of their own, so that `cflib`'s threads never keep the loop waiting.

`cflib` has two Python threads per vehicle. In one interpreter with the loop they take it from each other, for
milliseconds in one tick of a hundred. Here poses come up as they arrive, a record each; set-points go down, a datagram
for all vehicles, which is answered with the time at which the last one had left. Everything else (arming, recording, the
samples at the end) is a call over a pipe.
"""

from __future__ import annotations

import contextlib
import gc
import math
import multiprocessing
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence

from openjax.errors import UserError
from openjax.flying import real_time
from openjax.flying.controller import Pose
from openjax.flying.safety import Sighting
from openjax.flying.set_point import SetPoint
from openjax.flying.swarm import Member, Samples, Swarm

SILENCE = 1.0
"""The links' process is taken for dead if it doesn't pass on set-points for this long (s)."""
_POSE = struct.Struct("<i16d")  # vehicle; arrival, voltage, time, position, velocity, quaternion, body rates
_NUMBER = struct.Struct("<q")
_SET_POINT = struct.Struct("<i4d")
_SENT = struct.Struct("<qd")  # number of the set-points, when the last one had left


class Links:
    """Crazyflies, real or virtual, over links in another process; to the loop what it flies.

    Args: as `openjax.flying.swarm.Swarm`.
    """

    def __init__(
        self,
        uris: Sequence[str],
        body_logs: int = 1,
        watchdog: bool = False,
        clock: Callable[[], float] = time.perf_counter,
    ):
        self._uris, self._options, self._now = tuple(uris), (body_logs, watchdog), clock
        n = len(self._uris)
        self.poses: list[Pose | None] = [None] * n
        self._arrivals, self._voltages = [-math.inf] * n, [math.nan] * n
        self._rest, self._count, self._calls = b"", 0, 0
        self._process, self._lock = None, threading.Lock()
        self._blocks: tuple[int, ...] = ()

    def connect(self, timeout: float = 20.0) -> None:
        """Open all links and start the log blocks.

        Raises:
          UserError: cflib isn't there, a vehicle doesn't answer, or lacks a variable.
        """
        context = multiprocessing.get_context("spawn")
        self._heard = context.RawArray("d", [self._now()] * len(self._uris))
        self._stream, stream = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._control, control = context.Pipe()
        self._stream.setblocking(False)
        self._commands.settimeout(SILENCE)
        self._process = context.Process(
            target=_serve,
            args=(self._uris, *self._options, timeout, self._heard, stream, commands, control),
            daemon=True,
            name="openjax links",
        )
        self._process.start()
        for end in (stream, commands, control):
            end.close()
        try:
            complaint, self._blocks = self._control.recv()
        except EOFError as error:
            raise UserError("the links' process ended before it had connected") from error
        if complaint is not None:
            self._process.join()
            self._process = None
            raise UserError(complaint)

    @property
    def pid(self) -> int:
        """Of the links' process."""
        return self._process.pid

    def _call(self, name: str, *arguments):
        """The result of a method of the swarm over there."""
        with self._lock:
            self._calls += 1
            number = self._calls
            self._control.send((number, name, arguments))
        answered = 0
        while answered != number:  # answers of interrupted calls may still be there
            answered, result = self._control.recv()
        return result

    def _drain(self) -> None:
        """Take in the poses that have arrived."""
        while True:
            try:
                data = self._stream.recv(1 << 16)
            except BlockingIOError:
                return
            if not data:
                return
            data = self._rest + data
            whole = len(data) - len(data) % _POSE.size
            self._rest = data[whole:]
            for vehicle, arrival, voltage, at, *numbers in _POSE.iter_unpack(data[:whole]):
                parts = (tuple(numbers[a:b]) for a, b in ((0, 3), (3, 6), (6, 10), (10, 13)))
                self.poses[vehicle] = Pose(at, *parts)
                self._arrivals[vehicle], self._voltages[vehicle] = arrival, voltage

    def wait(self, until: float) -> None:
        """Return at `until` (s), or as soon as a pose arrives."""
        left = until - self._now()
        if left > 0:
            select.select([self._stream], [], [], left)

    def sightings(self) -> tuple[Sighting, ...]:
        """What is known of each vehicle now."""
        self._drain()
        return tuple(Sighting(*s) for s in zip(self.poses, self._heard, self._voltages, strict=True))

    def arrivals(self) -> tuple[float, ...]:
        """When each vehicle's newest pose arrived (s, host)."""
        self._drain()
        return tuple(self._arrivals)

    def send(self, set_points: Sequence[SetPoint]) -> float:
        """Send each vehicle its set-point; returns when the last one left (s).

        Raises:
          UserError: the links' process is gone or stuck.
        """
        self._count += 1
        packed = [_SET_POINT.pack(s.mode, s.roll, s.pitch, s.yaw_rate, s.thrust) for s in set_points]
        try:
            self._commands.send(_NUMBER.pack(self._count) + b"".join(packed))
            number = 0
            while number != self._count:
                number, sent = _SENT.unpack(self._commands.recv(_SENT.size))
        except OSError as error:
            raise UserError("the links' process is gone or stuck") from error
        return sent

    def send_pose(self, i: int, position, quaternion) -> None:
        """Tell vehicle i where motion capture sees it: (3,) m, (4,) wxyz."""
        with self._lock:
            self._control.send((0, "send_pose", (i, tuple(position), tuple(quaternion))))

    def arm(self, on: bool = True) -> None:
        """Arm or disarm all."""
        self._call("arm", on)

    def emergency_stop(self) -> None:
        """Stop all motors at once; the vehicles must be restarted afterwards."""
        self._call("emergency_stop")

    def record(self, on: bool = True) -> None:
        """Keep all samples from now on (or no longer)."""
        self._call("record", on)

    def samples(self) -> list[Samples]:
        """What was recorded of each vehicle."""
        return self._call("samples")

    def pose_blocks(self) -> tuple[int, ...]:
        """The id of each vehicle's pose block."""
        return self._blocks

    def close(self) -> None:
        """Motors off, links closed."""
        if self._process is None:
            return
        with contextlib.suppress(EOFError, OSError):
            self._call("close")
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        self._process = None
        for end in (self._stream, self._commands, self._control):
            end.close()


def _serve(uris, body_logs, watchdog, timeout, heard, stream, commands, control) -> None:
    """The links' process. It leaves the vehicles alone when the loop's process is gone: they are the guard's then."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which lands
    sys.setswitchinterval(5e-4)  # cflib's threads and the one that passes on set-points
    real_time.hurry()
    stream.setblocking(False)
    swarm, lock = Swarm(uris, body_logs, watchdog), threading.Lock()

    def pass_on(vehicle: int, member: Member, new_pose: bool) -> None:
        heard[vehicle] = member.heard
        if not new_pose:
            return
        pose = member.pose
        numbers = (pose.time, *pose.position, *pose.velocity, *pose.quaternion, *pose.body_rates)
        # nobody reads any more: then there is no loop to tell
        with lock, contextlib.suppress(OSError):
            stream.send(_POSE.pack(vehicle, member.arrival, member.voltage, *numbers))

    for i, member in enumerate(swarm.members):
        member.listener = lambda new_pose, i=i, member=member: pass_on(i, member, new_pose)
    try:
        swarm.connect(timeout)
    except UserError as error:
        control.send((str(error), ()))
        return
    gc.collect()
    gc.disable()
    threading.Thread(target=_send_on, args=(swarm, commands), daemon=True, name="set-points").start()
    control.send((None, swarm.pose_blocks()))
    while True:
        try:
            number, name, arguments = control.recv()
        except (EOFError, OSError):
            os._exit(1)
        result = getattr(swarm, name)(*arguments)
        if number:
            control.send((number, result))
        if name == "close":
            return


def _send_on(swarm: Swarm, commands: socket.socket) -> None:
    """Pass on set-points as they come."""
    while True:
        try:
            data = commands.recv(1 << 12)
            (number,) = _NUMBER.unpack_from(data)
            sent = swarm.send([SetPoint(*s) for s in _SET_POINT.iter_unpack(data[_NUMBER.size :])])
            commands.send(_SENT.pack(number, sent))
        except (OSError, struct.error):
            return
