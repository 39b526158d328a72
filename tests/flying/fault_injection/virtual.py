"""Virtual Crazyflies of an experiment, in a process of their own that keeps where they
truly were.
"""

from __future__ import annotations

import math
import multiprocessing
import time

import numpy as np

from openjax.flying.controller import Pose
from tests.flying.fault_injection.faults import Fault, PoseDamage

_POSE = 14  # time, position, velocity, quaternion, body rates
EVERY = 0.01
"""s between two rows of the track."""


class Truth:
    """Where the vehicles are, in shared memory: take-off, then a pose each."""

    def __init__(self, number: int, context):
        self.number, self._numbers = number, context.RawArray("d", 1 + _POSE * number)

    @property
    def take_off(self) -> float:
        """When motors turned first (s); infinite before."""
        return self._numbers[0] or math.inf

    def begin(self, take_off: float) -> None:
        """Motors turn since `take_off` (s); zero: they don't."""
        self._numbers[0] = take_off

    def write(self, now: float, report) -> None:
        """The vehicles are as `report` says at `now` (s)."""
        of_all = (report.position, report.velocity, report.quaternion, report.body_rates)
        self._numbers[1:] = np.column_stack([np.full(self.number, now), *of_all]).ravel().tolist()

    def poses(self) -> list[Pose]:
        """Of all vehicles."""
        rows = np.array(self._numbers[1:]).reshape(self.number, _POSE).tolist()
        return [
            Pose(r[0], tuple(r[1:4]), tuple(r[4:7]), tuple(r[7:11]), tuple(r[11:14])) for r in rows
        ]


class VirtualProcess:
    """Three virtual Crazyflies that can be put back to their stands; `uris`,
    `truth`.
    """

    def __init__(self, scenario: str):
        context = multiprocessing.get_context("spawn")
        self.truth = Truth(3, context)
        self._pipe, pipe = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(scenario, self.truth, pipe), daemon=True
        )
        self._process.start()
        self.uris = self._pipe.recv()

    def reset(self, fault: Fault) -> None:
        """All on their stands, switched off and on; the fault's damage is done to what
        they send.
        """
        self._pipe.send(fault)
        self._pipe.recv()

    def track(self) -> dict[str, np.ndarray]:
        """Since the last reset: time (T,), position (T, N, 3), off and armed (T, N),
        crashed (N,).
        """
        self._pipe.send(None)
        return self._pipe.recv()

    def close(self) -> None:
        """End them."""
        self._process.kill()
        self._process.join()


def _serve(scenario, truth, pipe) -> None:
    from openjax.commands.virtual_crazyflie import VirtualCrazyflieCommand, make
    from openjax.flying import real_time

    real_time.prepare()
    virtual = make(VirtualCrazyflieCommand(scenario=scenario, port=0))
    flown = _Flown(virtual, truth, pipe)
    real_time.hurry()
    pipe.send(virtual.uris)
    virtual.run(flown.look)


class _Flown:
    """What is looked at between two steps of the vehicles."""

    def __init__(self, virtual, truth, pipe):
        self._virtual = virtual
        self._truth = truth
        self._pipe = pipe
        self._sensors = virtual.vehicles.sensors
        virtual.vehicles.sensors = self.damaged
        self._reset(Fault("none", math.inf, 0))

    def _reset(self, fault):
        self._fault, self._damage = fault, PoseDamage(fault)
        self._virtual.vehicles.reset()
        for firmware, link in zip(self._virtual.firmware, self._virtual.links, strict=True):
            firmware.restart()
            link.faults = link.faults.__class__()
        self._rows = []
        self._last = 0.0
        self._truth.begin(0.0)

    def damaged(self, i):
        """What vehicle i senses, as its log blocks tell it."""
        sensors = self._sensors(i)
        now = time.perf_counter() - self._truth.take_off
        shown = (sensors.position, sensors.velocity, sensors.quaternion, sensors.body_rates)
        pose = Pose(now, *(tuple(x.tolist()) for x in shown))
        radioed = self._damage("radio", i, now, pose, ())
        if radioed is pose or radioed is None:
            return sensors
        parts = [
            np.array(p)
            for p in (radioed.position, radioed.velocity, radioed.quaternion, radioed.body_rates)
        ]
        return sensors.__class__(
            *parts, sensors.specific_force, sensors.motor_command, sensors.voltage
        )

    def look(self) -> bool:
        """Note where all are; do what is asked."""
        now = time.perf_counter()
        virtual = self._virtual
        report = virtual.vehicles.report
        self._truth.write(now, report)
        if now - self._last >= EVERY:
            self._last = now
            off = [f.set_point(virtual.time).mode == 0 for f in virtual.firmware]
            armed = [f.armed and not f.emergency for f in virtual.firmware]
            self._rows.append((now, report.position.copy(), off, armed))
            if math.isinf(self._truth.take_off) and not all(off):
                self._truth.begin(now)
            self._spoil(now - self._truth.take_off)
        if self._pipe.poll():
            request = self._pipe.recv()
            if request is None:
                times, positions, off, armed = zip(*self._rows, strict=True)
                crashed = [f.crashed for f in virtual.firmware]
                kinds = {
                    "time": times,
                    "position": positions,
                    "off": off,
                    "armed": armed,
                    "crashed": crashed,
                }
                self._pipe.send({name: np.array(values) for name, values in kinds.items()})
            else:
                self._reset(request)
                self._pipe.send("ready")
        return False

    def _spoil(self, now):
        """Do to a vehicle's link what the fault does."""
        fault = self._fault
        link, (up, down) = self._virtual.links[fault.vehicle], fault.losses(now)
        if fault.kind == "drone restarts" and fault.on(now):
            self._virtual.firmware[fault.vehicle].restart()
        link.faults = link.faults.__class__(loss=up, pose_loss=down)
