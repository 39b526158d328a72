"""The shared state of a flight's three processes: a page of shared memory that outlives any of
them.

The loop flies through the links. If it falls silent the links' process lands the vehicles; if that
one is silent too the guard does, over links of its own; if both are gone the loop does. Whoever
flies writes its state here, so that the next one can go on from it.
"""

import contextlib
import os
import select
import signal
from enum import IntEnum
from multiprocessing import resource_tracker

from openjax.flying.controller import moved_on, numbers_of, pose_of
from openjax.flying.state import Mode, State
from openjax.interruption import SIGNALS

SILENCE = 0.1
"""Silence of a process after which the next one flies (s): ten ticks."""
_MODES = tuple(Mode)
# Where things stand in the page: five words, a beat and a process id of each of the three roles,
# and then of each vehicle mode, trim, whether it has a pose, and the 14 numbers of that.
_BEATS = 5
_PIDS = 8
_HEAD = 11
_EACH = 17
DEAF = ("SIGHUP", "SIGINT", "SIGTSTP", "SIGTERM", "SIGQUIT", "SIGTTOU", "SIGTTIN", "SIGPIPE")
"""Signals that a terminal, or its end, sends to all that it started."""


class Role(IntEnum):
    """The processes of a flight, in the order in which they fly."""

    LOOP = 0
    LINKS = 1
    GUARD = 2


class _Word:
    """One number of the page, read and written as a `kind`."""

    def __init__(self, at: int, kind: type = bool):
        self._at = at
        self._kind = kind

    def __get__(self, board, _=None):
        return self._kind(int(board._numbers[self._at]))

    def __set__(self, board, value):
        board._numbers[self._at] = float(value)


class Board:
    """The page.

    Args:
      number: of vehicles.
      context: of multiprocessing.
      silence: see `SILENCE` (s).

    Attributes:
      flying: whether any motor may be on.
      pilot: the `Role` that flies.
      over: whether the session has ended.
      armed: whether any vehicle may be armed.
      stopped: whether the operator wants all motors off, whoever flies.
    """

    flying = _Word(0)
    pilot = _Word(1, Role)
    over = _Word(2)
    armed = _Word(3)
    stopped = _Word(4)

    def __init__(self, number: int, context, silence: float = SILENCE):
        self._numbers = context.RawArray("d", _HEAD + _EACH * number)
        self.silence = silence

    def beat(self, role: Role, time: float) -> None:
        """`role` lives at `time` (s)."""
        self._numbers[_BEATS + role] = time

    def silent(self, role: Role, time: float) -> float:
        """For how long (s) nothing was heard of `role`; infinite if it never was."""
        # the page begins with zeros
        return time - (self._numbers[_BEATS + role] or -float("inf"))

    def enter(self, role: Role) -> None:
        """This process is `role`'s."""
        self._numbers[_PIDS + role] = float(os.getpid())

    def leave(self, role: Role) -> None:
        """This process has nothing more to do with the flight: nobody need end it."""
        self._numbers[_PIDS + role] = 0.0

    def end_process(self, role: Role) -> None:
        """Kill the process of `role`, should there be one: if it woke up, two would
        fly. Returns once it has given back all that it held, a radio dongle above all.
        """
        pid = int(self._numbers[_PIDS + role])
        if pid:
            # it has gone already; and only Linux tells when one goes
            with contextlib.suppress(OSError, AttributeError):
                os.kill(pid, signal.SIGKILL)
                process = os.pidfd_open(pid)
                select.select([process], [], [], self.silence)
                os.close(process)

    def write(self, role: Role, time: float, state: State) -> None:
        """`role` flew a tick at `time` (s), and this is what it knows."""
        numbers = []
        for drone in state.drones:
            has_estimate = drone.estimate is not None
            # a row has its place for a pose's 14 numbers, known or not
            pose = numbers_of(drone.estimate) if has_estimate else (0.0,) * 14
            numbers += [float(_MODES.index(drone.mode)), drone.trim, float(has_estimate), *pose]
        self._numbers[_HEAD:] = numbers
        self.flying = state.flying
        # the beat comes last: who takes over for a silent process finds a page that is whole
        self.beat(role, time)

    def read(self, state: State, time: float) -> State:
        """`state` with what was written last, moved on to `time` (s): vehicles go on
        turning as they were told.
        """
        drones = []
        for i, drone in enumerate(state.drones):
            start = _HEAD + _EACH * i
            mode, trim, has_estimate, *numbers = self._numbers[start : start + _EACH]
            pose = moved_on(pose_of(numbers), time) if has_estimate else None
            drones.append(drone._replace(mode=_MODES[int(mode)], trim=trim, estimate=pose))
        # from now on: that no action came while nobody flew is no reason to stop
        return state._replace(drones=tuple(drones), time=time, action_time=time)


def start_deaf(process) -> None:
    """Start a process of multiprocessing that no Ctrl-C ends, in many lines, while it loads what it
    needs: signals that are blocked here are blocked there until it can `stand_alone`.
    """
    # Python starts its resource tracker with the first process, and unblocks signals for it
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def stand_alone() -> None:
    """Make this process its own: no terminal's signal reaches it, nor the end of
    whoever started it.
    """
    os.setsid()
    for name in DEAF:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def say(text: str) -> None:
    """A line on the terminal, if there still is one."""
    with contextlib.suppress(OSError):
        os.write(2, f"\r{text}\n".encode())
