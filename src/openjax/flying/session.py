"""A session: all that a flight needs and that must be given back, whatever happens:
command, links, guard, motion capture.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from openjax.errors import UserError
from openjax.flying import real_time
from openjax.flying.board import SILENCE, Role, say
from openjax.flying.crtp import Supervisor
from openjax.flying.flight_record import FlightRecord
from openjax.flying.guard import Guard
from openjax.flying.keys import Operator
from openjax.flying.links import Links
from openjax.flying.loop import FlightLoop
from openjax.flying.motion_capture import MotionCaptured
from openjax.flying.preflight import faults, poses_arriving
from openjax.flying.raw_links import RawLinks
from openjax.flying.recorder import LogOutcome, NewCase, Recorder
from openjax.flying.state import Request, State
from openjax.flying.takeover import fly_down
from openjax.flying.ticks import measured_times

STILL_ARMED = "a vehicle doesn't say that it is disarmed: keep away, and switch it off"
"""What is said after a flight that ends so."""
FRESH = 0.05
"""No flight begins with poses older than this (s): one every 10 ms is sent."""
ARMING = 1.0
"""A vehicle has this long (s) to say that it is armed."""
POSES = 5.0
"""And this long (s) to say where it is."""


@dataclass(frozen=True)
class SessionSettings:
    """Settings of how vehicles are connected and watched."""

    uris: tuple[str, ...]
    """Of the vehicles, in the order of the game: the pursuers first."""
    body_logs: int = 1
    """Log blocks of motors and accelerometer, 0 to 5: one is what a radio carries."""
    watchdog: bool = True
    """True if the firmware's watchdog stops the motors once nothing feeds it any more."""
    guard: bool = True
    """True if a process of its own watches, and lands all should loop and links fall silent."""
    silence: float = SILENCE
    """Of the loop, after which the links' process lands the vehicles (s)."""
    feed: Callable | None = None
    """Motion capture, see `openjax.flying.motion_capture`."""


class Session:
    """A context manager: inside, vehicles are connected and nobody else's.

    Args:
      settings: how.
      state: before the flight.
      case: where the flight is recorded; None: nowhere.
    """

    def __init__(self, settings: SessionSettings, state: State, case: NewCase | None = None):
        self._settings = settings
        self._state = state
        kind = Links if settings.feed is None else MotionCaptured
        self.links = kind(
            settings.uris, settings.body_logs, settings.watchdog, state, settings.silence
        )
        self.requests = Operator()
        self._recorder = Recorder(case, len(state.drones))
        self.record = FlightRecord(
            len(state.drones), self._recorder.tell_tick, self._recorder.tell_game
        )
        self._guard: Guard | None = None
        self.scheduler = "ordinary"
        """The parts of the real-time scheduling that were granted, see
        `openjax.flying.real_time`.
        """
        self._raw_links: RawLinks | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Session:
        settings = self._settings
        # what has begun by then is given back, in reverse, should any step here fail
        with self._stack as stack:
            self.links.board.enter(Role.LOOP)
            stack.callback(self.links.close)
            self.links.connect(log=self._recorder.links_pipe)
            if isinstance(self.links, MotionCaptured):
                self.links.feed(settings.feed, self._recorder.teller)
            self._wait_for_poses()
            blocks = self.links.pose_blocks()
            # the loop's own, should links and guard both go; over a dongle they open only then
            self._raw_links = RawLinks(settings.uris, blocks, settings.watchdog)
            if settings.guard:
                self._guard = Guard(self.links.board, self._raw_links, self._state)
                stack.callback(self._guard.close)
                self._guard.wait()
            stack.callback(self._recorder.close)
            self._recorder.start()
            self._raw_links.open(udp_only=True)
            self.scheduler = real_time.hurry()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_):
        self._stack.close()

    def check(self) -> None:
        """All that must be so before take-off. UserError: something isn't; where there
        is more, each stands in a line.
        """
        self._wait_for_poses()
        # first, as it takes half a second: what is judged is what is known after it
        rates = poses_arriving(self.links)
        has_guard = self._guard is None or self._guard.lives()
        problems = faults(self._state, self.links.observe(), rates, has_guard)
        if len(problems) == 1:
            raise UserError(f"no take-off: {problems[0]}")
        if problems:
            for line in problems:
                say(line)
            raise UserError(f"no take-off for these {len(problems)} reasons")

    def fly(self, flight: FlightLoop) -> LogOutcome:
        """Arm and fly; what became of the log, with a complaint where another process landed."""
        complaint = ""
        with self.requests:
            self._arm()
            self._recorder.begin(self.scheduler)
            try:
                flight.run()
            except Exception as error:  # whatever it is, vehicles are in the air
                complaint = f"{error}; {self._left_to_others()}"
            # the links are gone: the guard disarms
            with contextlib.suppress(UserError):
                if not self.links.disarm():
                    complaint = "; ".join(filter(None, (complaint, STILL_ARMED)))
            outcome = self._recorder.end([drone.reason for drone in flight.state.drones])
        complaint = "; ".join(filter(None, (complaint, outcome.complaint)))
        return outcome._replace(complaint=complaint)

    def watch(self, moment: float, state: State) -> str:
        """Tell the others that the loop lives and what it knows; why it must land, if it must."""
        self.links.board.write(Role.LOOP, moment, state)
        if self._guard is not None and not self._guard.lives():
            return "the guard is gone"
        return ""

    def _arm(self):
        deadline = time.monotonic() + ARMING
        while True:
            self.links.arm()  # a packet may be lost
            time.sleep(0.03)
            if all(s.supervisor & Supervisor.ARMED for s in self.links.observe()):
                return
            if time.monotonic() > deadline:
                raise UserError("a vehicle can't be armed; look at its console")

    def _left_to_others(self) -> str:
        """Return once the vehicles are down; land them here if nobody else does. What happened."""
        board = self.links.board
        lander = Role.LINKS
        if board.pilot is Role.LOOP:
            board.pilot = Role.LINKS
        while board.flying:
            time.sleep(0.005)
            time_read = time.perf_counter()
            board.beat(Role.LOOP, time_read)
            self._listen()
            lander = max(lander, board.pilot)
            if all(
                board.silent(role, time_read) > board.silence for role in (Role.LINKS, Role.GUARD)
            ):
                lander = Role.LOOP
                # should one of them wake up, two would fly, and a dongle serves one process
                for role in (Role.LINKS, Role.GUARD):
                    board.end_process(role)
                self._raw_links.open()
                fly_down(board, Role.LOOP, self._raw_links, self._state, self._listen)
        board.leave(Role.LOOP)
        return f"all vehicles were landed by the process of the {lander.name.lower()}"

    def _listen(self):
        """Tell whoever flies that the operator wants all motors off, if so."""
        if self.requests() is Request.STOP:
            self.links.board.stopped = True

    def _wait_for_poses(self):
        """Return once each vehicle has a pose that is fresh. UserError: one has none."""
        deadline = time.monotonic() + POSES
        while True:
            time_read = time.perf_counter()
            samples = self.links.observe()
            newest = zip(measured_times(samples), samples, strict=True)
            old = [not abs(time_read - t) <= FRESH or s.own is None for t, s in newest]
            if not any(old):
                return
            if time.monotonic() > deadline:
                uris: Sequence[str] = self._settings.uris
                silent = ", ".join(uri for uri, is_old in zip(uris, old, strict=True) if is_old)
                raise UserError(f"no pose from {silent} within {POSES:g} s; is its position known?")
            self.links.wait(time_read + 0.02)
