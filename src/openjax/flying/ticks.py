"""The times of the loop's ticks, and the wait for the poses of the next one."""

import itertools
import math
from collections.abc import Sequence
from time import perf_counter

from openjax.flying.links import Links

PERIOD = 0.01
"""Of the ticks (s)."""
MARGIN = 2.0e-3
"""A tick is due this long after the newest poses were measured (s), as far as the
fastest packets tell.
"""
EARLY = 3.0e-3
"""A tick begins as soon as all poses are there, up to this much before it is due (s)."""
PATIENCE = 5.0e-3
"""It begins without them this long after it could have begun (s)."""
GONE = 0.1
"""A vehicle whose newest pose is older (s) isn't waited for."""


class TickSchedule:
    """The times of the ticks: every 10 ms, just after the moments at which poses are measured.

    Those moments are regular, unlike arrivals: the vehicles send by clocks of their
    own, which drift a little.
    """

    def __init__(self, first: float):
        self.due = first
        self._in_step = False

    def next(self, time: float, pose_times: Sequence[float]) -> float:
        """The next tick's time, after one that ended at `time` and knew poses measured
        at `pose_times` (s).
        """
        ages = sorted((self.due - t) % PERIOD for t in pose_times if time - t < GONE)
        shift = 0.0
        if ages:
            # poses come in a bunch: the newest of a bunch is the one after the longest pause
            pauses = [ages[0] + PERIOD - ages[-1]]
            pauses += [older - newer for newer, older in itertools.pairwise(ages)]
            newest = ages[pauses.index(max(pauses))]
            # the way round the period that is shorter
            error = (newest - MARGIN + PERIOD / 2) % PERIOD - PERIOD / 2
            # slowly, once in step: one late packet mustn't move the ticks
            shift = min(max(0.02 * error, -1e-4), 1e-4) if self._in_step else error
            self._in_step = True
        # by a late tick the schedule isn't moved: the next one is due when it would have been
        self.due += PERIOD - shift
        while self.due < time - PERIOD:  # that one can't be caught up with any more
            self.due += PERIOD
        return self.due


def await_poses(vehicles: Links, due: float) -> None:
    """Return around `due` (s): as soon as each vehicle's newest pose is there that was
    measured before.
    """
    start = perf_counter()
    latest = max(due, start) + PATIENCE
    while True:
        time_read = perf_counter()
        stood_still = latest + PATIENCE < time_read < start + GONE
        if time_read >= latest and not stood_still:
            return
        if stood_still:
            # so may the links have, which have first to pass on what came
            due = time_read - PATIENCE
            latest = time_read + PATIENCE
        times = measured_times(vehicles.observe())
        complete = all(t > due - PERIOD or time_read - t > GONE for t in times)
        if complete and time_read >= due - EARLY:
            return
        vehicles.wait(due - EARLY if complete else latest)


def measured_times(samples) -> tuple[float, ...]:
    """The time at which each vehicle's newest pose was measured (s); minus infinity if there is
    none.
    """
    poses = (sample.captured or sample.own for sample in samples)
    return tuple(-math.inf if pose is None else pose.time for pose in poses)
