"""Vehicles in simulated time: virtual firmware and vehicles without sockets or clock, with faults to order.

What `Swarm` is to the loop, for flights that must not wait for a clock: a thousand faults in minutes.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np

from openjax.flying.controller import Pose
from openjax.flying.safety import PoseSample
from openjax.flying.set_point import SetPoint
from openjax.virtual_crazyflie.firmware import VirtualFirmware
from openjax.virtual_crazyflie.vehicles import STEP, VirtualVehicles

TICK = 0.01
"""s"""


@dataclass
class Faults:
    """What goes wrong with one vehicle from now on; changed while it flies."""

    command_loss: float = 0.0
    """Share of the set-points that are lost."""
    pose_loss: float = 0.0
    """Share of the poses that are lost."""
    command_delay: int = 0
    """Steps of 2 ms by which set-points come late."""
    voltage: float | None = None
    """What the battery is said to have (V)."""
    pose_jump: float = 0.0
    """Offset of the poses along x (m)."""


class SimulatedSwarm:
    """N vehicles that are advanced by `advance`."""

    def __init__(self, vehicles: VirtualVehicles, seed: int = 0, watchdog: bool = False):
        self.vehicles, self.now, self._watchdog = vehicles, 0.0, watchdog
        n = vehicles.number
        self.firmware = [VirtualFirmware(needs_arming=False) for _ in range(n)]
        self.faults = [Faults() for _ in range(n)]
        self._random = random.Random(seed)
        self._poses: list[Pose | None] = [None] * n
        self._heard = [0.0] * n
        self._voltage = [4.0] * n
        self._waiting: list[tuple[int, int, SetPoint]] = []
        self._steps = 0
        self.track: list[np.ndarray] = []  # (N, 3) m, after every tick
        self._look()

    def observe(self) -> tuple[PoseSample, ...]:
        """What is known of each vehicle now."""
        return tuple(PoseSample(*s) for s in zip(self._poses, self._heard, self._voltage, strict=True))

    def arrivals(self) -> tuple[float, ...]:
        """When each vehicle's newest pose arrived (s)."""
        return tuple(pose.time if pose is not None else -np.inf for pose in self._poses)

    def send(self, set_points) -> float:
        """Send each vehicle its set-point, or nothing where it is None."""
        for i, set_point in enumerate(set_points):
            if set_point is not None and self._random.random() >= self.faults[i].command_loss:
                self._waiting.append((self._steps + self.faults[i].command_delay, i, set_point))
        return self.now

    def advance(self) -> None:
        """One tick of 10 ms."""
        end = self._steps + round(TICK / STEP)
        while self._steps < end:
            self._deliver()
            steps = min((due - self._steps for due, _, _ in self._waiting), default=end)
            steps = min(steps, end - self._steps)
            wanted = np.stack([f.set_point(self._steps * STEP).array() for f in self.firmware])
            report = self.vehicles.advance(wanted, steps)
            self._steps += steps
            for firmware, crashed in zip(self.firmware, report.crashed, strict=True):
                if crashed:
                    firmware.crash()
        self.now = self._steps * STEP
        self.track.append(self.vehicles.report.position.copy())
        self._look()

    def _deliver(self):
        for due, i, set_point in self._waiting:
            if due <= self._steps:
                self.firmware[i].accept(set_point, self._steps * STEP)
                if self._watchdog:
                    self.firmware[i].feed_watchdog(self._steps * STEP)
        self._waiting = [w for w in self._waiting if w[0] > self._steps]

    def _look(self):
        report = self.vehicles.report
        for i, fault in enumerate(self.faults):
            if self._random.random() < fault.pose_loss:
                continue
            position = report.position[i] + [fault.pose_jump, 0.0, 0.0]
            self._poses[i] = Pose(
                self.now,
                tuple(position.tolist()),
                tuple(report.velocity[i].tolist()),
                tuple(report.quaternion[i].tolist()),
                tuple(report.body_rates[i].tolist()),
            )
            self._heard[i] = self.now
            self._voltage[i] = self.vehicles.sensors(i).voltage if fault.voltage is None else fault.voltage
