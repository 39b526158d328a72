"""Vehicles in simulated time: virtual firmware and vehicles without sockets or clock.

What `Swarm` is to the loop, for flights that must not wait for a clock. What the
vehicles and a camera would send passes through two functions, in which an experiment
can damage it at its source.
"""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from openjax.flying.controller import Pose
from openjax.flying.crtp import compress_quaternion, expand_quaternion
from openjax.flying.set_point import OFF, SetPoint, as_sent
from openjax.flying.state import PoseSample
from openjax.virtual_crazyflie.firmware import STEP, VirtualFirmware
from openjax.virtual_crazyflie.vehicles import VirtualVehicles

TICK = 0.01
"""s"""
FOLLOWING = (0.1, 0.5)
"""How the estimator on board follows motion capture: share of the innovation taken into
the position at each pose, and into the velocity (1/s). Steady state of a Kalman filter
for .01 m and .5 m/s^2 at 100 Hz (Kalata 1984: tracking index .005).
"""
CAMERA_NOISE = 5e-4
"""Of positions of motion capture, and of components of its quaternions."""

Damage = Callable[[int, float, Pose], Pose | None]
"""What is received of vehicle i at a time (s) in place of the true pose; None:
nothing.
"""


@dataclass
class Uplink:
    """What goes wrong with one vehicle's set-points, and what its battery is said to
    have; changed while it flies.
    """

    loss: float = 0.0
    """Share that is lost."""
    voltage: float | None = None
    """V"""


class SimulatedSwarm:
    """N vehicles that are advanced by `advance`.

    Args:
      vehicles: what flies.
      following: whether the estimator on board of each vehicle follows motion capture,
      as far as it is believed, instead of knowing its place by itself.
      radio, camera: what is received of own estimates and of motion capture.
    """

    def __init__(
        self, vehicles: VirtualVehicles, following: Sequence[bool], radio: Damage, camera: Damage
    ):
        self.vehicles = vehicles
        self.now = 0.0
        self._following = following
        self._radio = radio
        self._camera = camera
        n = vehicles.number
        self.firmware = [VirtualFirmware(needs_arming=False) for _ in range(n)]
        self.uplinks = [Uplink() for _ in range(n)]
        self._random = random.Random(0)  # losses, noise
        # of the own estimates from the truth: position, velocity
        self._offsets = np.zeros((n, 2, 3))
        self._samples = [PoseSample(None, 0.0, 4.0) for _ in range(n)]
        self._steps = 0
        self.asleep: set[int] = set()
        """Vehicles of which nothing new is told: nobody listens any more."""
        self._look()

    def observe(self) -> tuple[PoseSample, ...]:
        """The present knowledge of each vehicle."""
        return tuple(self._samples)

    def send(self, set_points: Sequence[SetPoint | None]) -> None:
        """Send each vehicle its set-point, and a word to its watchdog, or nothing where
        it is None.
        """
        for i, set_point in enumerate(set_points):
            if set_point is not None and self._random.random() >= self.uplinks[i].loss:
                command = set_point if set_point.mode == OFF else as_sent(set_point)
                self.firmware[i].accept(command, self.now)
                self.firmware[i].feed_watchdog(self.now)

    def believed(self, i: int, pose: Pose) -> None:
        """The estimator of vehicle i is told this pose of motion capture."""
        if not self._following[i]:
            return
        offset = self._offsets[i]
        truth = self.vehicles.report.position[i]
        innovation = np.asarray(pose.position) - truth - offset[0]
        offset[0] += FOLLOWING[0] * innovation
        offset[1] += FOLLOWING[1] * innovation

    def advance(self) -> None:
        """One tick of 10 ms."""
        set_points = np.array([f.set_point(self.now) for f in self.firmware], np.float32)
        steps = round(TICK / STEP)
        report = self.vehicles.advance(set_points, steps)
        self._steps += steps
        self.now = self._steps * STEP
        for firmware, crashed in zip(self.firmware, report.crashed, strict=True):
            if crashed:
                firmware.crash()
        self._offsets[:, 0] += TICK * self._offsets[:, 1]
        self._look()

    def _look(self):
        report = self.vehicles.report
        noise = self._random.gauss
        # in the packets' units: millimetres
        estimate = np.round(
            np.stack([report.position, report.velocity], 1) + self._offsets, 3
        ).tolist()
        position = report.position.tolist()
        quaternion = report.quaternion.tolist()
        rates = report.body_rates.tolist()
        voltage = self.vehicles.voltage().tolist()
        # in g, as half-precision numbers
        force = (9.81 * (report.specific_force / 9.81).astype(np.float16).astype(float)).tolist()
        for i, old in enumerate(self._samples):
            if i in self.asleep:
                continue
            shaken = [q + noise(0.0, CAMERA_NOISE) for q in quaternion[i]]
            size = math.sqrt(sum(q * q for q in shaken))
            place = tuple(p + noise(0.0, CAMERA_NOISE) for p in position[i])
            capture = Pose(self.now, place, (0.0, 0.0, 0.0), tuple(q / size for q in shaken))
            # as exact as a packet's 32 bits
            on_board = expand_quaternion(compress_quaternion(quaternion[i]))
            own_place, own_velocity = map(tuple, estimate[i])
            on_air = Pose(self.now, own_place, own_velocity, on_board, tuple(rates[i]))
            own_estimate = self._radio(i, self.now, on_air)
            voltage_of_link = self.uplinks[i].voltage
            self._samples[i] = PoseSample(
                own=own_estimate or old.own,
                last_contact=self.now if own_estimate else old.last_contact,
                voltage=voltage[i] if voltage_of_link is None else voltage_of_link,
                supervisor=self.firmware[i].supervisor_info if own_estimate else old.supervisor,
                captured=self._camera(i, self.now, capture) or old.captured,
                force=tuple(force[i]) if own_estimate else old.force,
            )
