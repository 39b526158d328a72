"""The real cflib over a dongle made for it: what UDP doesn't show."""

import threading
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cflib", reason='the extra "fly" is not installed')

from cflib.crtp import radiodriver

from openjax.flying.raw_links import RawLinks
from openjax.flying.set_point import OFF, RATES, SetPoint
from openjax.flying.swarm import Swarm
from openjax.virtual_crazyflie.firmware import VirtualFirmware
from openjax.virtual_crazyflie.tables import Sensors

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

NOTHING = np.zeros(3)
STILL = Sensors(NOTHING, NOTHING, np.array([1.0, 0, 0, 0]), NOTHING, NOTHING, np.zeros(4))
HOVER = SetPoint(RATES, 0.0, 0.0, 0.0, 0.3)


class Vehicle:
    """A virtual firmware behind a radio: what it has to say goes down with
    acknowledgements.
    """

    def __init__(self):
        self.firmware, self.answers, self.dead = (
            VirtualFirmware(needs_arming=False),
            deque(),
            False,
        )

    def receive(self, raw):
        now = time.perf_counter()
        self.answers += [] if raw == b"\xff" else self.firmware.receive(raw, now)
        self.answers += self.firmware.logs.packets(self.firmware, now, STILL)
        return self.answers.popleft() if self.answers else b""


@pytest.fixture
def vehicles(monkeypatch):
    """By URI, on one dongle."""
    air = [Vehicle() for _ in range(3)]
    lock = threading.Lock()

    class Dongle:
        version = 0.53
        DR_250KPS = 0
        DR_1MPS = 1
        DR_2MPS = 2

        def __init__(self, devid=0):
            self._address = None

        def set_address(self, address):
            self._address = address

        def send_packet(self, data):
            with lock:
                vehicle = air[self._address[0]]
                said = () if vehicle.dead else tuple(vehicle.receive(bytes(data)))
            time.sleep(1e-3)
            return SimpleNamespace(ack=not vehicle.dead, data=said, retry=0, powerDet=False)

        def ignore(self, *_):
            pass

        set_channel = set_data_rate = set_arc = close = ignore

    monkeypatch.setattr(radiodriver, "Crazyradio", Dongle)
    return {f"radio://0/80/2M/0{i}E7E7E7E7": vehicle for i, vehicle in enumerate(air)}


def send(links, seconds=2.0):
    """Set-points at 100 Hz, and poses of motion capture where they can be sent; the
    longest time (s) that they took.
    """
    longest = 0.0
    end = time.perf_counter() + seconds
    while (begin := time.perf_counter()) < end:
        for i in range(3 * hasattr(links, "send_pose")):
            links.send_pose(i, (begin, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        links.send([HOVER] * 3)
        longest = max(longest, time.perf_counter() - begin)
        time.sleep(0.01)
    return longest


def check_the_others_fly_on(links, vehicles):
    first, _, last = vehicles.values()
    before = [v.firmware.set_points for v in (first, last)]
    longest = send(links)
    end = time.perf_counter()
    assert longest < 0.1
    for vehicle, count in zip((first, last), before, strict=True):
        assert vehicle.firmware.set_points - count > 50
        if hasattr(links, "send_pose"):  # neither keeps the other out
            assert end - vehicle.firmware.external_pose[0] < 0.2
        assert vehicle.firmware.set_point(time.perf_counter()).mode != OFF


def test_a_vehicle_that_doesnt_answer_keeps_no_other_waiting(vehicles):
    """cflib waits two seconds for it, by when the others' watchdogs would have stopped
    their motors.
    """
    swarm = Swarm(list(vehicles))
    swarm.connect()
    try:
        send(swarm, 0.3)
        assert all(m.pose is not None for m in swarm.members)
        list(vehicles.values())[1].dead = True
        check_the_others_fly_on(swarm, vehicles)
    finally:
        swarm.close()


def test_nor_does_one_that_the_guard_never_reaches(vehicles):
    list(vehicles.values())[1].dead = True
    own = RawLinks(list(vehicles), [0, 0, 0])
    own.open()
    try:
        check_the_others_fly_on(own, vehicles)
    finally:
        own.close()
