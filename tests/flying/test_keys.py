"""Keys and signals: no stop is lost, whatever comes with it; a terminal that goes
lands.
"""

import itertools
import os
import pty
import signal
import subprocess
import sys

import pytest

from openjax.flying.board import DEAF
from openjax.flying.keys import Operator
from openjax.flying.state import Request


@pytest.fixture
def terminal():
    ours, theirs = pty.openpty()
    yield ours, theirs
    for end in (ours, theirs):
        try:
            os.close(end)
        except OSError:
            pass


def test_the_strongest_of_all_keys_of_one_read_counts(terminal):
    ours, theirs = terminal
    expected = {
        " ": Request.STOP,
        "q": Request.STOP,
        "l": Request.LAND,
        "h": Request.HOLD,
        "x": Request.NONE,
    }
    order = list(expected.values())
    with Operator(theirs) as operator:
        assert operator() is Request.NONE
        for length in (1, 2, 3):
            for keys in itertools.product(expected, repeat=length):
                os.write(ours, "".join(keys).encode())
                strongest = min((expected[key] for key in keys), key=order.index)
                assert operator() is strongest, keys
                assert operator() is Request.NONE


def test_bytes_of_no_key_at_all_dont_hide_a_stop(terminal):
    ours, theirs = terminal
    with Operator(theirs) as operator:
        os.write(ours, b"\x1b[A\xff\xc3 \xf0")
        assert operator() is Request.STOP


LANDING = ("SIGHUP", "SIGINT", "SIGTSTP", "SIGTERM", "SIGQUIT")


@pytest.mark.parametrize("name", LANDING)
def test_a_signal_lands_and_ends_nothing(name, terminal):
    before = [
        signal.getsignal(getattr(signal, each)) for each in LANDING
    ]  # a shell may have had some ignored
    with Operator(terminal[1]) as operator:
        for _ in range(3):
            signal.raise_signal(getattr(signal, name))
        assert operator() is Request.LAND
        assert operator() is Request.NONE
    assert [signal.getsignal(getattr(signal, each)) for each in LANDING] == before


def test_a_stop_beats_a_signal(terminal):
    ours, theirs = terminal
    with Operator(theirs) as operator:
        signal.raise_signal(signal.SIGINT)
        os.write(ours, b" ")
        assert operator() is Request.STOP


def test_a_terminal_that_is_gone_lands_once(terminal):
    ours, theirs = terminal
    with Operator(theirs) as operator:
        os.close(ours)
        assert operator() is Request.LAND
        assert operator() is Request.NONE


ALONE = """
import os
from openjax.flying.board import stand_alone
stand_alone()
print(os.getsid(0) == os.getpid(), flush=True)
print(input())
"""


def test_who_stands_alone_is_deaf_to_a_terminal_and_its_end():
    command = [sys.executable, "-c", ALONE]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "True\n"
            for name in DEAF:
                process.send_signal(getattr(signal, name))
            assert process.communicate("still there\n")[0] == "still there\n"
        finally:
            process.kill()
