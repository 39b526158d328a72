"""Poses from motion capture instead of the vehicles' own estimates.

The adapter of a laboratory is one function that runs for as long as there are poses:

    def poses(update):
        for frame in my_motion_capture():
            for vehicle, body in enumerate(frame.bodies):
                update(vehicle, body.position, body.quaternion)      # metres, wxyz, body to world

and `openjax fly --motion_capture my_lab:poses`. Velocities are differences, smoothed;
body rates come from the gyroscope on board. Each pose that was believed, and is near
what the vehicle knows, is also sent to it, for the estimator on board, by which the
vehicle lands should motion capture fail, or the loop.
"""

import math
import pkgutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from openjax.errors import UserError
from openjax.flying.controller import Pose, numbers_of
from openjax.flying.links import Links
from openjax.flying.record_pipe import RecordKind, Teller
from openjax.flying.state import PoseSample


def find_feed(name: str) -> Callable:
    """The function MODULE:FUNCTION; modules in the present folder are found too. Raises
    UserError.
    """
    # a console script's path begins with where it is installed, not with where it is called
    sys.path.insert(0, str(Path.cwd()))
    try:
        feed = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"--motion_capture {name}: no such MODULE:FUNCTION ({error})") from error
    finally:
        sys.path.pop(0)
    if not callable(feed):
        raise UserError(f"--motion_capture {name}: is no function")
    return feed


class MotionCaptured(Links):
    """Vehicles whose poses come from outside. Arguments as of `Links`."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self._captured: list[Pose | None] = [None] * len(self.counts)
        self._teller = Teller(None)
        self._arrived = threading.Event()

    def feed(self, function: Callable, teller: Teller) -> None:
        """Let `function(update)` run in a thread of its own; what is believed is told."""
        self._teller = teller
        threading.Thread(
            target=function, args=(self.update,), daemon=True, name="motion capture"
        ).start()

    def update(self, vehicle: int, position, quaternion, at: float | None = None) -> None:
        """Vehicle `vehicle` was seen at position (3,) m, attitude (4,) wxyz, at `at`
        (s, host clock; default now).

        It is judged before anything flies by it, see `openjax.flying.judge`.
        """
        at = time.perf_counter() if at is None else at
        position = tuple(map(float, position))
        quaternion = tuple(map(float, quaternion))
        # put there whole: the loop's thread sees this pose or the one before
        self._captured[vehicle] = Pose(at, position, (0.0, 0.0, 0.0), quaternion)
        self._arrived.set()

    def believed(self, vehicle: int, pose: Pose, feeds_estimator: bool) -> None:
        """This pose of motion capture was judged good: it is told to the recorder, and
        sent to the vehicle if it `feeds_estimator`.
        """
        self._teller.row(RecordKind.CAPTURE, vehicle, numbers_of(pose))
        if feeds_estimator:
            self.send_pose(vehicle, pose)

    def wait(self, until: float) -> None:
        """Return at `until` (s), or as soon as motion capture sends a pose."""
        self._arrived.wait(max(until - time.perf_counter(), 0.0))
        self._arrived.clear()

    def observe(self) -> tuple[PoseSample, ...]:
        """The latest samples of each vehicle."""
        samples = super().observe()
        return tuple(s._replace(captured=p) for p, s in zip(self._captured, samples, strict=True))

    def arrivals(self) -> tuple[float, ...]:
        """The time at which each vehicle's newest pose of motion capture arrived (s, host)."""
        return tuple(-math.inf if p is None else p.time for p in self._captured)
