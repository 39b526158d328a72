"""Requests of the person at the terminal: keys, and the signals that a terminal sends."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys

from openjax.flying.board import DEAF
from openjax.flying.state import Request
from openjax.interruption import settle

STOP = b" qQ"
LAND = b"lL"
HOLD = b"hH"
LANDING = ("SIGHUP", "SIGINT", "SIGTSTP", "SIGTERM", "SIGQUIT")
"""Ctrl-C, Ctrl-Z, Ctrl-\\ , a closed terminal, and kill: all of them land, however
often they come.
"""


class Operator:
    """Keys and signals while vehicles fly; a context manager.

    Space or q stops all motors, l lands, h waits; signals land. Keys are read byte by byte from the
    terminal itself, and of all that have come since the last look the strongest counts.

    Args:
      terminal: a file descriptor; keys are read only if it is a terminal.
    """

    def __init__(self, terminal: int | None = None):
        self._terminal = terminal
        self._signalled = False
        self._restore = contextlib.ExitStack()

    def __enter__(self) -> Operator:
        for name in DEAF:
            handler = self._signal if name in LANDING else signal.SIG_IGN
            previous = signal.signal(getattr(signal, name), handler)
            self._restore.callback(signal.signal, getattr(signal, name), previous)
        if self._terminal is None:
            with contextlib.suppress(ValueError, OSError, AttributeError):
                self._terminal = sys.stdin.fileno()
        if self._terminal is not None and os.isatty(self._terminal):
            import termios
            import tty

            previous = termios.tcgetattr(self._terminal)
            self._restore.callback(_give_back, self._terminal, previous)
            tty.setcbreak(self._terminal)
        else:
            self._terminal = None
        return self

    def __exit__(self, *_):
        # what has come by now was this object's to hear, and mustn't be taken for an unheard signal
        settle()
        self._restore.close()

    def _signal(self, *_):
        self._signalled = True

    def __call__(self) -> Request:
        """The requests since the last look."""
        keys = self._keys()
        if any(key in STOP for key in keys):
            return Request.STOP
        if self._signalled or any(key in LAND for key in keys):
            self._signalled = False
            return Request.LAND
        return Request.HOLD if any(key in HOLD for key in keys) else Request.NONE

    def _keys(self) -> bytes:
        """The bytes that have come. A terminal that has gone lands."""
        if self._terminal is None or not select.select([self._terminal], [], [], 0)[0]:
            return b""
        try:
            keys = os.read(self._terminal, 4096)
        except OSError:
            keys = b""
        if not keys:
            self._terminal = None
            self._signalled = True
        return keys


def _give_back(terminal, settings):
    """The terminal as it was."""
    import termios

    with contextlib.suppress(termios.error, OSError):  # it has been closed
        termios.tcsetattr(terminal, termios.TCSADRAIN, settings)
