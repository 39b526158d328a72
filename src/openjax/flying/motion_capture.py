"""Poses from motion capture instead of the vehicles' own estimates.

The adapter of a laboratory is one function that runs for as long as there are poses:

    def poses(update):
        for frame in my_motion_capture():
            for vehicle, body in enumerate(frame.bodies):
                update(vehicle, body.position, body.quaternion)      # metres, wxyz, body to world

and `python -m openjax.fly --motion_capture my_lab:poses`. Velocities are differences, smoothed; body rates come from the
gyroscope on board. Each pose is also sent to its vehicle, for the estimator on board and for the guard, which flies by it.
"""

from __future__ import annotations

import importlib
import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from openjax.errors import UserError
from openjax.flying.controller import Pose
from openjax.flying.safety import Sighting
from openjax.flying.swarm import Swarm

SMOOTHING = 0.02
"""Time constant of the velocity's low-pass (s)."""


def find_feed(name: str) -> Callable:
    """The function MODULE:FUNCTION; modules in the present folder are found too. Raises UserError."""
    module, _, function = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"--motion_capture {name}: no such MODULE:FUNCTION ({error})") from error
    finally:
        sys.path.pop(0)


class MotionCaptured:
    """A swarm whose poses come from outside; to the loop what `Swarm` is.

    Args:
        swarm: its links.
        clock: host time (s).
    """

    def __init__(self, swarm: Swarm, clock: Callable[[], float] = time.perf_counter):
        self._swarm, self._now = swarm, clock
        self._poses: list[Pose | None] = [None] * len(swarm.members)

    def feed(self, function: Callable) -> None:
        """Let `function(update)` run in a thread of its own."""
        threading.Thread(target=function, args=(self.update,), daemon=True, name="motion capture").start()

    def update(self, vehicle: int, position, quaternion, at: float | None = None) -> None:
        """Vehicle `vehicle` was seen at position (3,) m, attitude (4,) wxyz, at `at` (s, host clock; default now).

        What isn't finite is left out, so that a lost body counts as a lost pose.
        """
        at = self._now() if at is None else at
        position, quaternion = tuple(map(float, position)), tuple(map(float, quaternion))
        if not all(map(math.isfinite, (*position, *quaternion))):
            return
        old = self._poses[vehicle]
        velocity = (0.0, 0.0, 0.0)
        if old is not None and at > old.time:
            step = at - old.time
            share = 1.0 - math.exp(-step / SMOOTHING)
            velocity = tuple(
                v + share * ((p - q) / step - v)
                for p, q, v in zip(position, old.position, old.velocity, strict=True)
            )
        member = self._swarm.members[vehicle]
        rates = member.pose.body_rates if member.pose is not None else (0.0, 0.0, 0.0)
        pose = Pose(at, position, velocity, quaternion, rates)
        self._poses[vehicle] = pose
        if member.recording:
            member.seen.append(pose)
        self._swarm.send_pose(vehicle, position, quaternion)

    def sightings(self) -> tuple[Sighting, ...]:
        """What is known of each vehicle now."""
        own = self._swarm.sightings()
        return tuple(Sighting(p, s.heard, s.voltage) for p, s in zip(self._poses, own, strict=True))

    def arrivals(self) -> tuple[float, ...]:
        """When each vehicle's newest pose arrived (s, host)."""
        return tuple(-math.inf if p is None else p.time for p in self._poses)

    def send(self, set_points) -> float:
        """See `Swarm.send`."""
        return self._swarm.send(set_points)
