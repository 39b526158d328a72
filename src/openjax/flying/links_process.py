"""The links' process: `cflib`'s threads live here, and what leads to the loop and back.

Should the loop stop, it lands the vehicles (`openjax.flying.takeover`). The loop's end
of it is `openjax.flying.links`.
"""

import contextlib
import functools
import gc
import math
import os
import socket
import struct
import sys
import threading
import time
from typing import Any, NamedTuple

from openjax.flying import real_time
from openjax.flying.board import Board, Role, say, stand_alone
from openjax.flying.controller import numbers_of
from openjax.flying.guard import CHECK
from openjax.flying.member import SwarmMember
from openjax.flying.record_pipe import RecordKind, Teller
from openjax.flying.set_point import SetPoint
from openjax.flying.state import State
from openjax.flying.swarm import Swarm
from openjax.flying.takeover import disarm, fly_down

POSE_RECORD = struct.Struct("<iI19d")
"""Vehicle, supervisor; arrival, voltage, specific force (NaN: unknown), and of the pose
time, position, velocity, quaternion, body rates.
"""
_NO_FORCE = (math.nan,) * 3
"""Of a vehicle whose pose block doesn't hold it."""
SET_POINTS_NUMBER = struct.Struct("<q")
"""Number of the set-points, before all of them."""
SET_POINT_RECORD = struct.Struct("<i4d")
"""The five fields of a `SetPoint`."""
SENT_RECORD = struct.Struct("<qd")
"""Number of the set-points, when the last one had left."""


class Connection(NamedTuple):
    """The vehicles that the links' process connects to, and the way it does."""

    uris: tuple[str, ...]
    body_logs: int
    watchdog: bool
    timeout: float
    """For each vehicle (s)."""


class Ends(NamedTuple):
    """The links' process' ends of all that leads to the loop."""

    contacts: Any
    """Shared memory: when anything was heard of each vehicle (s)."""
    stream: socket.socket
    """Poses go up."""
    commands: socket.socket
    """Set-points come down."""
    control: Any
    """A pipe for all else, by calls."""
    log: Any
    """A pipe to the recorder, where there is one."""


def serve(
    connection: Connection, ends: Ends, board: Board, parent: int, state: State | None
) -> None:
    """The links' process. Should the loop stop, it lands the vehicles; with nothing in
    the air it ends with the loop.
    """
    stand_alone()
    board.enter(Role.LINKS)
    sys.setswitchinterval(5e-4)  # cflib's threads and the one that passes on set-points
    threading.excepthook = _say_nothing  # of cflib's threads, when their socket goes
    real_time.hurry()
    swarm = Swarm(connection.uris, connection.body_logs, connection.watchdog)
    threading.Thread(
        target=_watch, args=(swarm, board, parent, state), daemon=True, name="watch"
    ).start()
    _pass_on(swarm, ends.contacts, ends.stream)
    teller = Teller(ends.log, batch=2048)  # 15 ms of three vehicles
    for i, member in enumerate(swarm.members):
        member.tell = functools.partial(_tell, teller, i)
    try:
        swarm.connect(connection.timeout)
    except Exception as error:  # whatever cflib raises, too
        ends.control.send((" ".join(str(error).split()) or type(error).__name__, ()))
        os._exit(0)  # cflib's threads may hang
    # a search for garbage would keep poses and set-points waiting for milliseconds
    gc.collect()
    gc.disable()
    threading.Thread(
        target=_send_on, args=(swarm, ends.commands, board), daemon=True, name="set-points"
    ).start()
    ends.control.send((None, swarm.pose_blocks()))
    with contextlib.suppress(EOFError, OSError):
        _answer(swarm, ends.control, board)
    threading.Event().wait()  # the loop is gone: the watch ends the process


def _say_nothing(_) -> None:
    """In place of the traceback of a thread."""


def _tell(teller: Teller, vehicle: int, kind: RecordKind, row) -> None:
    """Tell the recorder what was sampled on board of a vehicle."""
    teller.row(kind, vehicle, row)


def _pass_on(swarm: Swarm, contacts, stream: socket.socket) -> None:
    """Have all poses go up the stream as they arrive, and when anything was heard of a
    vehicle into `contacts`.
    """
    lock = threading.Lock()
    # who hears the vehicles must never wait for a loop that doesn't read
    stream.setblocking(False)

    def pass_on(vehicle: int, member: SwarmMember, new_pose: bool) -> None:
        contacts[vehicle] = member.last_contact
        if new_pose:
            force = member.sample().force or _NO_FORCE
            numbers = (member.arrival, member.voltage, *force, *numbers_of(member.pose))
            record = POSE_RECORD.pack(vehicle, member.supervisor, *numbers)
            # nobody reads any more: then there is no loop to tell
            with lock, contextlib.suppress(OSError):
                stream.send(record)

    for i, member in enumerate(swarm.members):
        member.listener = functools.partial(pass_on, i, member)


def _answer(swarm: Swarm, control, board: Board) -> None:
    """Answer the loop's calls until it closes the links, which ends the process."""
    while True:
        number, name, arguments = control.recv()
        disarming = name in ("disarm", "close")
        result = disarm(swarm, board, Role.LINKS) if disarming else getattr(swarm, name)(*arguments)
        if number:
            control.send((number, result))
        if name == "close":
            os._exit(0)


def _send_on(swarm: Swarm, commands: socket.socket, board: Board) -> None:
    """Pass on set-points as they come, as long as it's the loop that flies."""
    while True:
        try:
            data = commands.recv(1 << 12)
            (number,) = SET_POINTS_NUMBER.unpack_from(data)
            if board.pilot is not Role.LOOP:
                return
            records = SET_POINT_RECORD.iter_unpack(data[SET_POINTS_NUMBER.size :])
            sent_at = swarm.send([SetPoint._make(numbers) for numbers in records])
            commands.send(SENT_RECORD.pack(number, sent_at))
        except (OSError, struct.error):
            return


def _watch(swarm: Swarm, board: Board, parent: int, state: State | None) -> None:
    """Beat; land for a loop that is silent; end the process once the loop's has and
    nothing flies.
    """
    while True:
        time.sleep(CHECK)
        time_read = time.perf_counter()
        board.beat(Role.LINKS, time_read)
        silent = board.silent(Role.LOOP, time_read)
        is_over = board.pilot is Role.LINKS or (board.pilot is Role.LOOP and silent > board.silence)
        if is_over and board.flying and state is not None:
            say(
                f"openjax fly: the loop has been silent for {silent:.2f} s, so the links' process "
                "lands all vehicles"
            )
            fly_down(board, Role.LINKS, swarm, state)
        if os.getppid() != parent and not board.flying:
            if board.armed:
                disarm(swarm, board, Role.LINKS)
            os._exit(1)
