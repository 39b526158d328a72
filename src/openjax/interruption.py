"""Ctrl-C and SIGTERM: a command ends at once, by one line, and leaves no file half
written.

Python runs a signal's handler between two of its own instructions, in the main thread.
While XLA compiles there are none, for minutes. Here a thread hears of signals from the
descriptor that Python's handler in C writes to (`signal.set_wakeup_fd`). An ordinary
exit would wait for the compiler's threads, or end them in their middle ("FATAL:
exception not rethrown"); so the process leaves by `os._exit`, after what must be given
back.
"""

import contextlib
import math
import os
import select
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 5.0
"""Seconds that everything together may take which is given back before the process
ends.
"""
SHOW_CURSOR = b"\r\x1b[?25h\n"
"""A live display hides the cursor, and leaves it in the middle of a line."""


class _Watch:
    """State of the thread that waits for signals."""

    def __init__(self):
        self.descriptor: int | None = None
        self.deciding = threading.Lock()
        self.patience = math.inf
        self.unfinished: list[Path] = []
        self.clean_ups: list[Callable[[], None]] = []
        self.last_words: list[Callable[[], str]] = []
        self.undivided = threading.RLock()
        self.leaving = threading.Lock()  # is never given back

    @property
    def installed(self) -> bool:
        return self.descriptor is not None


_watch = _Watch()


def install() -> None:
    """From now on SIGINT and SIGTERM end this process at once; for commands, from their
    main thread, before anything is loaded that takes its time.
    """
    reader, writer = os.pipe()
    for descriptor in (reader, writer):
        os.set_blocking(descriptor, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in SIGNALS:
        # what a shell starts in the background doesn't hear Ctrl-C, and neither do we
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _left_to_the_watch)
    _watch.descriptor = reader
    threading.Thread(target=_listen, daemon=True, name="signals").start()


def _left_to_the_watch(number, frame):
    """The handler in Python has nothing to do."""


def _listen() -> None:
    while True:
        select.select([_watch.descriptor], [], [])
        settle()


def settle() -> None:
    """Decide what the signals mean that have come by now. To be called before it is
    changed who handles them: the thread that hears of them may not have had its turn.
    """
    if not _watch.installed:
        return
    with _watch.deciding:
        numbers = b""
        with contextlib.suppress(BlockingIOError):
            numbers = os.read(_watch.descriptor, 64)
        for number in numbers:
            is_unhandled = signal.getsignal(number) is _left_to_the_watch
            if number in SIGNALS and (is_unhandled or _watch.patience < 1):
                leave(number)
            _watch.patience -= 1


@contextlib.contextmanager
def patience(signals: int) -> Iterator[None]:
    """Leave so many signals to other handlers inside; the process ends at the next one. By default
    all of them.
    """
    settle()
    previous = _watch.patience
    _watch.patience = signals
    try:
        yield
    finally:
        settle()
        _watch.patience = previous


@contextlib.contextmanager
def _inside(entries: list, entry: object) -> Iterator[None]:
    """Among the watch's entries while the caller is inside."""
    entries.append(entry)
    try:
        yield
    finally:
        entries.remove(entry)


def unfinished(path: Path) -> contextlib.AbstractContextManager[None]:
    """A file or folder that is removed should the process end inside."""
    return _inside(_watch.unfinished, path)


def clean_up(function: Callable[[], None]) -> contextlib.AbstractContextManager[None]:
    """Something to be called, in another thread, should the process end inside."""
    return _inside(_watch.clean_ups, function)


def last_words(words: Callable[[], str]) -> contextlib.AbstractContextManager[None]:
    """Set what the line says after the signal's name, should the process end inside."""
    return _inside(_watch.last_words, words)


@contextlib.contextmanager
def undivided() -> Iterator[None]:
    """A few steps between which the process doesn't end."""
    with _watch.undivided:
        yield


@contextlib.contextmanager
def as_exception() -> Iterator[None]:
    """Inside, both signals raise KeyboardInterrupt: for loops in Python that end in
    good order. To be entered in the main thread.
    """
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        settle()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def leave(number: int) -> None:
    """End the process for the signal of this number. Returns only where nothing is
    installed.
    """
    if not _watch.installed:
        return
    _watch.leaving.acquire()
    # a few steps that mustn't be parted may be under way; if they hang, the process
    # ends anyhow
    _watch.undivided.acquire(timeout=PATIENCE)
    # in a thread of its own: whatever hangs there, the process ends
    cleaner = threading.Thread(target=_clean_up, daemon=True)
    cleaner.start()
    cleaner.join(PATIENCE)
    words = "stopped"
    with contextlib.suppress(Exception):
        words = _watch.last_words[-1]() if _watch.last_words else words
    with contextlib.suppress(OSError):
        if os.isatty(1):
            os.write(1, SHOW_CURSOR)
        os.write(2, f"{signal.Signals(number).name}: {words}\n".encode())
    # what a shell says of a program that this signal ended
    os._exit(128 + number)


def _clean_up() -> None:
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    for function in reversed(_watch.clean_ups):
        with contextlib.suppress(Exception):
            function()
    # twice: a thread may have been about to put one more file into a folder
    for path in 2 * _watch.unfinished:
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


class StopRequest:
    """SIGINT and SIGTERM as a run handles them; a context manager.

    Where something is being learnt (`while_learning`), they ask to stop after the
    present update, and a second one interrupts at once. Elsewhere, above all while
    something is compiled, a command ends at once: its run goes on from what was saved.
    In a program of somebody else's, where `install` wasn't called, they ask to stop
    there, too.
    """

    def __init__(self):
        self.name: str | None = None
        self._previous = {}
        self._stack = contextlib.ExitStack()

    def __enter__(self):
        for number in SIGNALS:
            self._previous[number] = signal.signal(number, self._ask)
        self._stack.callback(self._give_back)
        self._stack.enter_context(patience(0))
        return self

    def __exit__(self, *_):
        self._stack.close()

    @contextlib.contextmanager
    def while_learning(self) -> Iterator[None]:
        """Inside, the first signal only sets `name`."""
        with patience(1):
            yield

    @contextlib.contextmanager
    def while_compiling(self) -> Iterator[None]:
        """Where, inside `while_learning`, something is waited for: a signal ends the
        command at once, also one that came before.
        """
        with patience(0):
            if self.name is not None:
                leave(signal.Signals[self.name])
            yield

    def _ask(self, number, frame):
        self.name = signal.Signals(number).name
        if not _watch.installed:  # else the watch counts them
            self._give_back()

    def _give_back(self):
        settle()
        for number, handler in self._previous.items():
            signal.signal(number, handler)
