"""Connecting ends, whatever answers or doesn't, and leaves no process behind."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

pytest.importorskip("cflib", reason='the extra "fly" is not installed')

from openjax.errors import UserError
from openjax.flying.links import Links


@pytest.fixture
def mute():
    """The URI of a vehicle that hears and says nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        yield f"udp://127.0.0.1:{listener.getsockname()[1]}"


def test_a_vehicle_that_says_nothing_is_a_line(mute):
    with pytest.raises(UserError, match="no connection") as error:
        Links([mute]).connect(timeout=1.0)
    assert mute in str(error.value) and "\n" not in str(error.value)


CONNECTING = """
import sys
from openjax.flying.links import Links

if __name__ == "__main__":
    print("connecting", flush=True)
    Links([sys.argv[1]]).connect(timeout=100.0)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_links_process_doesnt_outlive_one_that_is_killed_while_it_connects(mute, tmp_path):
    script = tmp_path / "connecting.py"
    script.write_text(CONNECTING)
    loop = subprocess.Popen([sys.executable, str(script), mute], stdout=subprocess.PIPE)
    children = []
    try:
        assert loop.stdout.readline() == b"connecting\n"
        deadline = time.monotonic() + 60.0
        while (
            len(children) < 2 and time.monotonic() < deadline
        ):  # the links' and multiprocessing's own
            time.sleep(0.1)
            with open(f"/proc/{loop.pid}/task/{loop.pid}/children") as file:
                children = [int(child) for child in file.read().split()]
        time.sleep(2.0)  # it has loaded cflib, and connects
        os.kill(loop.pid, signal.SIGKILL)
        loop.wait()
        deadline = time.monotonic() + 60.0  # it would go on trying for longer
        while (left := [c for c in children if _lives(c)]) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not left
    finally:
        loop.kill()
        for child in children:
            if _lives(child):
                os.kill(child, signal.SIGKILL)


def _lives(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False
