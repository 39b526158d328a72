"""The guard: a process that waits for nothing else, and lands all vehicles should loop
and links fall silent.

It has a session and signals of its own, watches loop and links, and is watched by the
loop, which lands without it.

Over UDP its links are open from the start. A radio dongle belongs to one process: there
the guard can only open it once the links' process has ended. The links' process, which
has it, is the first to take over for a loop that stops.
"""

from __future__ import annotations

import multiprocessing
import os
import time

from openjax.flying import real_time
from openjax.flying.board import Board, Role, say, stand_alone, start_deaf
from openjax.flying.raw_links import RawLinks
from openjax.flying.state import State
from openjax.flying.takeover import disarm, fly_down

CHECK = 0.004
"""s between two looks: short beside the silence after which somebody else flies."""
OPENING = 0.5
"""s that nobody takes over from the guard while it opens a dongle: half of what the
firmware's watchdog waits.
"""


class Guard:
    """The loop's end of the guard's process: start it before take-off, close it at the end.

    Args:
      board: of the session.
      links: the guard's own, not open yet.
      state: of the loop's state machine; settings, pillars and airframe are taken from
      it.
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
        """True if the process gave a sign of life lately."""
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
        time_read = time.perf_counter()
        board.beat(Role.GUARD, time_read)
        links_silent = board.silent(Role.LINKS, time_read) > board.silence
        # three times as long as the links wait: should they live and not take over
        loop_late = board.silent(Role.LOOP, time_read) > 3.0 * board.silence
        loop_silent = board.pilot is Role.LOOP and loop_late
        if board.flying and (links_silent or loop_silent):
            board.pilot = Role.GUARD
            board.beat(Role.GUARD, time_read + OPENING)
            board.end_process(Role.LINKS)
            say("openjax fly: the links' process is silent, so the guard lands all vehicles")
            links.open()
            fly_down(board, Role.GUARD, links, state)
        # on the floor, but armed: whoever comes near must not be met by a motor
        elif board.armed and not board.flying and links_silent:
            board.end_process(Role.LINKS)
            links.open()
            disarm(links, board, Role.GUARD)
        elif not board.flying and os.getppid() != parent and (links_silent or not board.armed):
            break
    os._exit(0)  # the links' threads would take a second each
