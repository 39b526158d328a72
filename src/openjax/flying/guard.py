"""Landing by another process than the loop, and the process that waits for nothing else.

`fly_down` is what each process does that takes over: wait where all are, land, disarm, say so. The
guard's process has a session and signals of its own, watches loop and links, and is watched by the
loop, which lands without it.

Over UDP its links are open from the start. A radio dongle belongs to one process: there the guard
can only open it once the links' process has ended. The links' process, which has it, is the first
to take over for a loop that stops.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import struct
import time
from collections.abc import Callable, Sequence

from openjax.flying import real_time
from openjax.flying.board import Board, Role, say, stand_alone, start_deaf
from openjax.flying.crtp import LOG_TYPES, Port, Supervisor, SupervisorCommand
from openjax.flying.safety import resting_places_of, step
from openjax.flying.set_point import SetPoint
from openjax.flying.state import FLYING, LANDING, Event, Mode, PoseSample, Request, State
from openjax.flying.swarm import (
    POSE_BLOCK,
    WATCHDOG_PERIOD,
    Member,
    Swarm,
    never_wait,
    send_set_point,
)

CHECK = 0.004
"""s between two looks: short beside the silence after which somebody else flies."""
DISARMING = 1.0
"""A vehicle is asked to disarm until it says that it has, for so long (s)."""
OPENING = 0.5
"""s that nobody takes over from the guard while it opens a dongle: half of what the firmware's
watchdog waits.
"""
TICK = 0.01


def take_over(state: State, now: float) -> State:
    """The state in which another process goes on flying: all stop where they are, wait, and
    land.
    """

    def handed_over(drone, anchor):
        if drone.mode not in FLYING:
            return drone
        # who lands goes on landing, and who had just lifted off is nearest to the floor
        mode = Mode.LAND if drone.mode in (*LANDING, Mode.LIFT) else Mode.HOLD
        # the estimate is as good as what the one before knew
        drone = drone._replace(seen=now)
        return drone.to(mode, now, anchor, "another process took over")

    drones = tuple(map(handed_over, state.drones, resting_places_of(state)))
    return state._replace(drones=drones, time=now, action_time=now)


def fly_down(
    board: Board,
    role: Role,
    vehicles: Swarm | RawLinks,
    state: State,
    listen: Callable[[], None] = lambda: None,
) -> State:
    """Wait and land from what stands on the board, disarm; the last state.

    Args:
      board: of the session.
      role: whose process this is; it gives up should another one take over.
      vehicles: links.
      state: any of this flight, for its settings, pillars and airframe.
      listen: called at each tick; has the board say so if the operator wants all motors off.
    """
    board.pilot = role
    now = due = time.perf_counter()
    state = take_over(board.read(state, now), now)
    while state.flying and board.pilot is role:
        listen()
        request = Request.STOP if board.stopped else Request.NONE
        event = Event(time.perf_counter(), vehicles.observe(), request=request)
        state, set_points = step(state, event)
        vehicles.send(set_points)
        board.write(role, time.perf_counter(), state)
        # ticks that were missed aren't flown one after the other
        due = max(due + TICK, time.perf_counter() - TICK)
        time.sleep(max(due - time.perf_counter(), 0.0))
    if board.pilot is role:
        disarm(vehicles, board, role)
        board.write(role, time.perf_counter(), state)
        say("openjax fly: all vehicles are down and disarmed")
        time.sleep(3.0 * board.silence)
        for other in Role:  # what still hangs would only be in the way
            if other is not role and board.silent(other, time.perf_counter()) > 3.0 * board.silence:
                board.end_process(other)
    return state


def disarm(vehicles: Swarm | RawLinks, board: Board, role: Role) -> bool:
    """Ask all to disarm until they have, or nothing is heard of it; whether all have. `role`: whose
    process this is.
    """
    deadline = time.perf_counter() + DISARMING
    while True:
        board.beat(role, time.perf_counter())
        vehicles.send([SetPoint()] * len(vehicles.observe()))
        vehicles.arm(False)
        time.sleep(0.03)
        # a vehicle that arms by itself always says that it is armed
        either = Supervisor.ARMED | Supervisor.AUTO_ARM
        armed = any(s.supervisor & either == Supervisor.ARMED for s in vehicles.observe())
        if not armed or time.perf_counter() > deadline:
            board.armed = armed
            return not armed


class RawLinks:
    """Links without `cflib`'s vehicle around them: packets of the pose block in, set-points out.

    Args:
      uris: of the vehicles.
      pose_blocks: ids of their pose blocks, which other links have set up.
      watchdog: whether those feed the firmware's watchdog, which bites if nobody goes on.
    """

    def __init__(self, uris: Sequence[str], pose_blocks: Sequence[int], watchdog: bool = True):
        self._members: list[Member] = []
        self._blocks = tuple(pose_blocks)
        self._links = dict.fromkeys(uris)
        self._watchdog = watchdog
        self._fed = -math.inf
        self._names = [name for name, _ in POSE_BLOCK]
        self._layout = "<" + "".join(LOG_TYPES[kind][1] for _, kind in POSE_BLOCK)

    def open(self, udp_only: bool = False) -> None:
        """Open what isn't open yet."""
        import cflib.crtp

        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        self._members = self._members or [Member(uri) for uri in self._links]
        for uri, link in self._links.items():
            if link is None and (uri.startswith("udp:") or not udp_only):
                self._links[uri] = cflib.crtp.get_link_driver(uri, lambda *_: None, lambda *_: None)
                never_wait(self._links[uri])

    def observe(self) -> tuple[PoseSample, ...]:
        """What is known of each vehicle, after what has arrived."""
        for member, link, block in zip(
            self._members, self._links.values(), self._blocks, strict=True
        ):
            while (packet := link.receive_packet(0)) is not None:
                member.last_contact = time.perf_counter()
                data = bytes(packet.data)
                if (packet.port, packet.channel) != (Port.LOG, 2) or data[:1] != bytes([block]):
                    continue
                # block, three bytes of time, and the variables
                if len(data) == 4 + struct.calcsize(self._layout):
                    values = dict(
                        zip(self._names, struct.unpack(self._layout, data[4:]), strict=True)
                    )
                    member.pose_arrived(int.from_bytes(data[1:4], "little"), values)
        return tuple(member.sample() for member in self._members)

    def send(self, set_points: Sequence[SetPoint]) -> float:
        """Send each vehicle its set-point; returns when the last one left (s)."""
        for link, set_point in zip(self._links.values(), set_points, strict=True):
            send_set_point(link, set_point)
        now = time.perf_counter()
        if self._watchdog and now - self._fed > WATCHDOG_PERIOD:
            self._fed = now
            self._supervise(SupervisorCommand.FEED_WATCHDOG)
        return now

    def arm(self, on: bool) -> None:
        """Arm or disarm all."""
        self._supervise(SupervisorCommand.ARM, on)

    def _supervise(self, *data: int):
        from cflib.crtp.crtpstack import CRTPPacket

        for link in self._links.values():
            packet = CRTPPacket()
            packet.set_header(Port.SUPERVISOR, 1)
            packet.data = data
            link.send_packet(packet)

    def close(self) -> None:
        """Close all."""
        for link in self._links.values():
            if link is not None:
                link.close()


class Guard:
    """The loop's end of the guard's process: start it before take-off, close it at the end.

    Args:
      board: of the session.
      own: its links, not open yet.
      state: of the loop's state machine; settings, pillars and airframe are taken from it.
    """

    def __init__(self, board: Board, links: RawLinks, state: State):
        self._board = board
        context = multiprocessing.get_context("spawn")
        self._process = context.Process(
            target=watch, args=(board, os.getpid(), links, state), name="openjax guard"
        )
        start_deaf(self._process)

    def wait(self, timeout: float = 20.0) -> None:
        """Return once it watches, which takes a second, or doesn't by then (s)."""
        deadline = time.monotonic() + timeout
        while not self.lives() and time.monotonic() < deadline and self._process.is_alive():
            time.sleep(0.02)

    def lives(self) -> bool:
        """Whether anything was heard of it lately."""
        return self._board.silent(Role.GUARD, time.perf_counter()) < 2.0 * self._board.silence

    def close(self) -> None:
        """End it; the vehicles are down or someone else's."""
        self._board.over = True
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def watch(board: Board, parent: int, links: RawLinks, state: State) -> None:
    """The guard's process."""
    stand_alone()
    links.open(udp_only=True)
    real_time.hurry()
    board.enter(Role.GUARD)
    while not board.over:
        time.sleep(CHECK)
        now = time.perf_counter()
        board.beat(Role.GUARD, now)
        links_silent = board.silent(Role.LINKS, now) > board.silence
        # three times as long as the links wait: should they live and not take over
        loop_late = board.silent(Role.LOOP, now) > 3.0 * board.silence
        loop_silent = board.pilot is Role.LOOP and loop_late
        if board.flying and (links_silent or loop_silent):
            board.pilot = Role.GUARD
            board.beat(Role.GUARD, now + OPENING)
            board.end_process(Role.LINKS)
            say("openjax fly: nothing from the links' process, the guard lands all vehicles")
            links.open()
            fly_down(board, Role.GUARD, links, state)
        elif board.armed and not board.flying and links_silent:
            board.end_process(Role.LINKS)
            links.open()
            disarm(links, board, Role.GUARD)
        elif not board.flying and os.getppid() != parent and (links_silent or not board.armed):
            break
    os._exit(0)  # the links' threads would take a second each
