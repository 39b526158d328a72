"""A vehicle is the same however its URI is written, and belongs to one `fly` at a
time.
"""

import socket
import subprocess
import sys

import pytest

from openjax.commands.fly import FlyCommand, check, fly
from openjax.errors import UserError
from openjax.flying.endpoints import endpoint_of, sole_command

FIRST = "udp://127.0.0.1:19850"


@pytest.mark.parametrize(
    "uri, same",
    [
        ("udp://localhost:19850", FIRST),
        ("udp://LOCALHOST:19850/", FIRST),
        ("UDP://127.0.0.1:19850", FIRST),
        ("udp://127.0.0.1:019850/", FIRST),
        ("udp://127.0.0.1", FIRST),
        ("udp://127.1:19850", FIRST),
        ("udp://0.0.0.0:19850", FIRST),
        (f"udp://{socket.gethostname()}:19850", FIRST),
        ("radio://0/80/2M/E7E7E7E7E7/", "radio://0/80/2M/E7E7E7E7E7"),
        ("RADIO://0/80/2m/e7e7e7e7e7", "radio://0/80/2M/E7E7E7E7E7"),
        ("radio://1/080", "radio://0/80/2M/E7E7E7E7E7"),
        ("radio://0/80/2M/1", "radio://0/80/2M/0000000001?rate_limit=100"),
    ],
)
def test_a_vehicle_is_the_same_however_it_is_written(uri, same):
    assert endpoint_of(uri).name == endpoint_of(same).name
    with pytest.raises(UserError, match="twice"):
        check(FlyCommand(uri=(same, "udp://10.0.0.1:1"), evader_uri=uri))


@pytest.mark.parametrize(
    "other", ["udp://127.0.0.1:19851", "udp://10.0.0.1:19850", "radio://0/80/2M/E7E7E7E7E7"]
)
def test_others_are_others(other):
    assert endpoint_of(other).name != endpoint_of(FIRST).name
    assert endpoint_of(other).uri == other


@pytest.mark.parametrize(
    "uri",
    ["", "udp://", "udp://:19850", "udp://h:0", "udp://h:70000", "usb://0", "radio://0/126/2M/E7",
     "radio://0/80/3M", "radio://0/80/2M/XYZ", "127.0.0.1:19850", "udp://h:1/path"],
)  # fmt: skip
def test_what_is_no_vehicle_is_a_line(uri):
    with pytest.raises(UserError, match="expected udp://HOST:PORT"):
        endpoint_of(uri)


HOLDER = """
from openjax.flying.endpoints import sole_command
with sole_command(["udp://127.0.0.1:19980", "udp://127.0.0.1:19981"]):
    print("held", flush=True)
    input()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux's abstract names")
def test_a_second_fly_is_refused_first_of_all_until_the_first_is_gone(monkeypatch):
    free = "udp://127.0.0.1:19982"
    first = subprocess.Popen(
        [sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )

    def prepare(arguments):
        raise AssertionError("it compiles")

    monkeypatch.setattr("openjax.commands.fly.prepare", prepare)
    try:
        assert first.stdout.readline() == b"held\n"
        with pytest.raises(UserError, match="has this vehicle"):
            fly(FlyCommand(uri=(free, "UDP://localhost:19981/")))
        with sole_command([free]):  # what was held before the refusal is free again
            pass
    finally:
        first.kill()
        first.wait()
    with sole_command(["udp://127.0.0.1:19980", "udp://127.0.0.1:19981"]):
        pass
