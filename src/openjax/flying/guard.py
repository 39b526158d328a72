"""A second process that lands the vehicles if the first one stops: killed, frozen, or stuck.

The loop tells it at every tick that it lives and what it knows; when nothing has come for `TAKE_OVER` seconds while
vehicles fly, the guard ends the loop's process, opens links of its own, and flies the safety's wait-and-land. The
firmware alone would hold the last body rates for half a second, which is enough to leave any arena.

Over UDP its links are open from the start. A radio dongle belongs to one process: there the guard can only open it once
the other one has ended.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import struct
import time
from dataclasses import replace
from types import SimpleNamespace

from openjax.flying import real_time
from openjax.flying.controller import Pose
from openjax.flying.crtp import LOG_TYPES, Port
from openjax.flying.limits import SafetySettings, resting_places
from openjax.flying.safety import (
    FLYING,
    Drone,
    Event,
    Mode,
    Sighting,
    State,
    step,
)
from openjax.flying.set_point import OFF, manual_arguments
from openjax.flying.swarm import POSE_BLOCK, Member

TAKE_OVER = 0.1
"""Silence of the loop after which the guard flies (s)."""
CHECK = 0.004
"""s between two looks."""
_MODES = tuple(Mode)
_HEAD, _EACH = 3, 16  # beat, flying, message; per vehicle mode, trim, known, 13 numbers of its pose
_READY, _OVER = 1.0, 2.0


def take_over(settings: SafetySettings, state: State, now: float) -> State:
    """The state in which another process goes on flying: all stop where they are, wait, and land."""
    anchors = resting_places(settings, state.pillars, [d.estimate for d in state.drones])
    drones = tuple(
        replace(d, mode=Mode.HOLD, since=now, anchor=a, reason="the loop stopped")
        if d.mode in FLYING and d.mode not in (Mode.LAND, Mode.BLIND)
        else d
        for d, a in zip(state.drones, anchors, strict=True)
    )
    return replace(state, drones=drones, time=now, action_time=now)


class Guard:
    """The loop's end of it: start it before take-off, call it at every tick, close it at the end.

    Args:
      uris: of the vehicles.
      pose_blocks: ids of their pose blocks, as the log set them up.
      safety: limits.
      state: of the loop's state machine; starts, pillars and airframe are taken from it.
      after: silence of the loop after which it flies (s).
      links: the links' process, which it ends with the loop's.
    """

    def __init__(
        self,
        uris,
        pose_blocks,
        safety: SafetySettings,
        state: State,
        after: float = TAKE_OVER,
        links: int | None = None,
    ):
        context = multiprocessing.get_context("spawn")
        self._shared = context.RawArray("d", _HEAD + _EACH * len(uris))
        self._process = context.Process(
            target=watch,
            args=(self._shared, tuple(uris), tuple(pose_blocks), safety, state, after, os.getpid(), links),
            daemon=False,
            name="openjax guard",
        )
        self._process.start()

    def wait(self, timeout: float = 20.0) -> bool:
        """Whether it's watching; it takes a second to start."""
        deadline = time.monotonic() + timeout
        while self._shared[2] != _READY and time.monotonic() < deadline and self._process.is_alive():
            time.sleep(0.02)
        return self._shared[2] == _READY

    def __call__(self, now: float, state: State) -> None:
        """The loop lives, and this is what it knows."""
        numbers = []
        for drone in state.drones:
            e = drone.estimate
            pose = (*e.position, *e.velocity, *e.quaternion, *e.body_rates) if e is not None else (0.0,) * 13
            numbers += [float(_MODES.index(drone.mode)), drone.trim, float(e is not None), *pose]
        self._shared[_HEAD:] = numbers
        self._shared[1] = float(state.flying)
        self._shared[0] = now

    def hand_over(self) -> None:
        """Let it fly on: it ends this process before it does."""
        while self._process.is_alive():
            time.sleep(0.1)

    def close(self) -> None:
        """End it; the vehicles are down or someone else's."""
        self._shared[1], self._shared[2] = 0.0, _OVER
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()


def watch(shared, uris, pose_blocks, safety, state, after, parent, links) -> None:
    """The guard's process."""
    import cflib.crtp

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which lands
    cflib.crtp.init_drivers()
    real_time.hurry()
    own = {uri: _open(uri) for uri in uris if uri.startswith("udp:")}
    shared[2] = _READY
    while shared[2] == _READY:
        time.sleep(CHECK)
        silent = shared[1] > 0.0 and shared[0] > 0.0 and time.perf_counter() - shared[0] > after
        if not silent:
            if os.getppid() != parent and shared[1] == 0.0:  # it ended, and nothing flies
                break
            continue
        for process in (parent, links):  # should one wake up, two would fly
            with contextlib.suppress(ProcessLookupError, TypeError):
                os.kill(process, signal.SIGKILL)
        own |= {uri: _open(uri) for uri in uris if uri not in own}
        land(shared, [own[uri] for uri in uris], uris, pose_blocks, safety, state)
        break
    for link in own.values():
        link.close()


def _open(uri):
    import cflib.crtp

    return cflib.crtp.get_link_driver(uri, lambda *_: None, lambda *_: None)


def land(shared, links, uris, pose_blocks, safety, state) -> State:
    """Fly wait-and-land over raw links until all motors are off; the last state."""
    from cflib.crazyflie.commander import Commander

    now = time.perf_counter()
    members = [Member(uri, time.perf_counter) for uri in uris]
    drones = []
    for i in range(len(uris)):
        mode, trim, known, *numbers = shared[_HEAD + _EACH * i : _HEAD + _EACH * (i + 1)]
        pose = None
        if known:
            pose = Pose(shared[0], *(tuple(numbers[a:b]) for a, b in ((0, 3), (3, 6), (6, 10), (10, 13))))
            members[i].pose = pose
        drones.append(Drone(mode=_MODES[int(mode)], trim=trim, estimate=pose))
    state = take_over(safety, replace(state, drones=tuple(drones)), now)
    commanders = [Commander(SimpleNamespace(send_packet=link.send_packet)) for link in links]
    names = [name for name, _ in POSE_BLOCK]
    layout = "<" + "".join(LOG_TYPES[kind][1] for _, kind in POSE_BLOCK)
    due = now
    while state.flying:
        for member, link, block in zip(members, links, pose_blocks, strict=True):
            while (packet := link.receive_packet(0)) is not None:
                member.heard = time.perf_counter()
                data = bytes(packet.data)
                if (packet.port, packet.channel) != (Port.LOG, 2) or data[0] != block:
                    continue
                stamp = int.from_bytes(data[1:4], "little")
                if len(data) == 4 + struct.calcsize(layout):
                    values = struct.unpack(layout, data[4:])
                    member.pose_arrived(stamp, dict(zip(names, values, strict=True)))
        sightings = tuple(Sighting(m.pose, m.heard, m.voltage) for m in members)
        state, set_points = step(safety, state, Event(time.perf_counter(), sightings))
        for commander, set_point in zip(commanders, set_points, strict=True):
            if set_point.mode == OFF:
                commander.send_stop_setpoint()
            else:
                commander.send_setpoint_manual(*manual_arguments(set_point))
        due += 0.01
        time.sleep(max(due - time.perf_counter(), 0.0))
    return state
