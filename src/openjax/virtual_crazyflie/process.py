"""Virtual Crazyflies in real time: links, firmware and vehicles of one process."""

import math
import select
import time
from collections.abc import Callable

import numpy as np

from openjax.flying.endpoints import UDP_PORT
from openjax.virtual_crazyflie.firmware import STEP, VirtualFirmware
from openjax.virtual_crazyflie.link import LinkFaults, VirtualLink
from openjax.virtual_crazyflie.logs import SAME
from openjax.virtual_crazyflie.vehicles import VirtualVehicles

LONGEST_WAIT = 0.02
"""The vehicles are advanced at least this often (s)."""
LATE = 0.02
"""An advance of more than this (s) says that the machine is too slow, or was busy."""


class VirtualCrazyflies:
    """N virtual Crazyflies on consecutive ports, in one air.

    Args:
      vehicles: what flies.
      host: address to listen at.
      port: first port; 0 takes any free ones.
      faults: what the links do.
      needs_arming: see `VirtualFirmware`.
    """

    def __init__(
        self,
        vehicles: VirtualVehicles,
        host: str = "127.0.0.1",
        port: int = UDP_PORT,
        faults: LinkFaults | None = None,
        needs_arming: bool = True,
    ):
        self.vehicles = vehicles
        self.late = 0
        self.firmware = [VirtualFirmware(needs_arming) for _ in range(vehicles.number)]
        self.links: list[VirtualLink] = []
        faults = faults or LinkFaults()
        try:
            for i in range(vehicles.number):
                self.links.append(VirtualLink(host, port + i if port else 0, faults, i))
        except BaseException:
            self.close()
            raise
        self._set_points = np.zeros((vehicles.number, 5), np.float32)
        self.uris = [f"udp://{host}:{link.port}" for link in self.links]
        self._steps = 0

    @property
    def time(self) -> float:
        """s that the vehicles have flown."""
        return self._steps * STEP

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Fly in real time until `stop()`, which is asked some hundred times a
        second.
        """
        start = time.perf_counter() - self.time
        sockets = [link.socket for link in self.links]
        while not stop():
            due = min(
                *(link.next_due() for link in self.links),
                *(firmware.logs.next() for firmware in self.firmware),
                self.time + LONGEST_WAIT,
            )
            # nothing happens between two steps: who looked again and again would take a
            # core, and the real-time scheduler then stops it for 50 ms in each second
            due = STEP * math.ceil(due / STEP - 1e-6)
            wait = due - (time.perf_counter() - start)
            if wait > 0:
                select.select(sockets, [], [], wait)
            self.catch_up(time.perf_counter() - start)

    def catch_up(self, until: float) -> None:
        """Take in what has arrived, advance everything to `until` (s), send what is
        due.
        """
        packets = []
        for i, link in enumerate(self.links):
            link.poll(until)
            packets += [(due, i, raw, peer) for due, raw, peer in link.received(until)]
        # in the order of all links: vehicles are in one air, and advance together up to
        # each packet
        for due, i, raw, peer in sorted(packets, key=lambda packet: packet[0]):
            self._advance(due)
            for answer in self.firmware[i].receive(raw, max(due, self.time)):
                self.links[i].send(answer, until, peer)
        self._advance(until)
        for i, (firmware, link) in enumerate(zip(self.firmware, self.links, strict=True)):
            if firmware.logs.next() <= self.time + SAME:
                for packet in firmware.logs.packets(firmware, self.time, self.vehicles.sensors(i)):
                    link.send(packet, until)
            link.flush(until)

    def _advance(self, until: float) -> None:
        # a quotient of floats may lie a hair below its whole number
        steps = int(until / STEP + 1e-6) - self._steps
        latest = [firmware.set_point(self.time) for firmware in self.firmware]
        set_points = np.array(latest, np.float32)
        if steps < 1 and (set_points == self._set_points).all():
            return
        self._set_points = set_points
        steps = max(steps, 0)
        self.late += steps * STEP > LATE + LONGEST_WAIT
        report = self.vehicles.advance(set_points, steps)
        self._steps += steps
        for i, firmware in enumerate(self.firmware):
            firmware.flying = bool(report.motor_command[i].max() > 0.05)
            if report.crashed[i]:
                firmware.crash()

    def close(self) -> None:
        """Give the ports back."""
        for link in self.links:
            link.close()
