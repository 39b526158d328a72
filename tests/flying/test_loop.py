"""The loop without links: what its ticks leave behind, and what its record says of
them.
"""

import gc
import time
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.flying import ticks
from openjax.flying.controller import GRAVITY, Pose, nominal_airframe
from openjax.flying.course import FlightPlan
from openjax.flying.flight_record import FlightRecord
from openjax.flying.game import Play
from openjax.flying.loop import FlightLoop, flight_state
from openjax.flying.state import Mode, PoseSample, SafetySettings
from openjax.flying.ticks import PATIENCE, await_poses

TICKS = 400
STARTS = ((0.5, 0.3, 0.5), (0.5, 0.0, 0.5), (0.5, -0.3, 0.5))


class Hovering:
    """Links to three level vehicles that rise and sink as their thrust has it, and a
    game whose policy hovers.
    """

    airframe = nominal_airframe()
    settings = SimpleNamespace(num_pursuers=3, pillar_radius=0.1, max_speed=1.0)
    task = SimpleNamespace(
        pursuer_position=np.array(STARTS), evader_position=np.zeros(3), pillar_position=np.zeros((1, 2)),
        pillar_active=np.zeros(1, bool),
    )  # fmt: skip

    def __init__(self):
        self.now = 0.0
        self.height = 0.0
        self.climb = 0.0
        self._nothing = np.zeros(3)
        self._action = np.array([[2 * self.airframe.hover_thrust - 1, 0.0, 0.0, 0.0]] * 3)

    def observe(self):
        shake = 1e-4 * np.sin(1e3 * self.now)
        poses = [
            Pose(
                self.now, (x + shake, y, self.height), (0.0, 0.0, self.climb), (1.0, 0.0, 0.0, 0.0)
            )
            for x, y, _ in STARTS
        ]
        return tuple(PoseSample(pose, self.now, 4.0) for pose in poses)

    def arrivals(self):
        return (self.now,) * 3

    def send(self, set_points):
        lift = set_points[0].thrust / self.airframe.hover_thrust
        self.climb = max(self.climb + 0.01 * GRAVITY * (lift - 1.0), -1e3 * self.height)
        self.height = max(self.height + 0.01 * self.climb, 0.0)
        return self.now + 1e-3

    def start(self, poses):
        return self.step(poses)

    def step(self, poses, evader=None):
        return Play(
            self._action,
            self._nothing,
            self._nothing,
            False,
            False,
            self._nothing,
            self._nothing.astype(bool),
        )


@pytest.fixture
def flight():
    """In the middle of a game, and a function that goes on for some ticks."""
    links = Hovering()
    flight = FlightLoop(links, links, flight_state(links, 3, SafetySettings()), FlightPlan())

    def go_on(ticks):
        for _ in range(ticks):
            links.now += 0.01
            flight.tick(links.now, links.now - 5e-4)

    go_on(700)
    assert flight.state.all_in(Mode.PURSUIT), [d.reason for d in flight.state.drones]
    return flight, go_on


def test_ticks_leave_half_a_kilobyte_each_and_nothing_to_collect(flight):
    """The garbage collector is off in flight; two kilobytes a tick were 128 MB in
    eleven minutes.
    """
    _, go_on = flight
    gc.collect()
    gc.disable()
    tracemalloc.start()
    try:
        go_on(1000)  # by then the interpreter keeps as many tuples for later as it will
        before = tracemalloc.get_traced_memory()[0]
        go_on(TICKS)
        grown = tracemalloc.get_traced_memory()[0] - before
        unreachable = gc.collect()
    finally:
        tracemalloc.stop()
        gc.enable()
    assert grown < TICKS * 512 and unreachable < 100


def test_a_flight_may_end_before_its_first_tick():
    assert FlightRecord(3).timing() == {"ticks": 0}


def test_poses_that_are_never_of_now_end_a_flight_that_hasnt_begun():
    """A motion capture that stamps them by another clock: nothing flies, and the flight
    says why.
    """
    links = Hovering()
    flight = FlightLoop(links, links, flight_state(links, 3, SafetySettings()), FlightPlan())
    begin = time.perf_counter()
    for k in range(0, 2200, 100):
        flight.tick(begin + 0.01 * k, begin)
    assert flight.over and "starts" in flight.state.drones[0].reason


def test_the_record_says_when_each_tick_was_due_and_done(flight):
    flight, _ = flight
    ticks, vehicles = flight.record.table()
    assert ticks.shape == (700, 3) and vehicles.shape == (700, 3, 7)
    timing = flight.record.timing()
    assert timing["ticks"] == 700 and timing["missed_deadlines"] == 0
    assert timing["command_age_ms"]["p50"] == timing["measured_to_sent_ms"]["max"] == 1.0
    assert timing["due_to_sent_ms"]["p99"] == 1.5


@pytest.mark.parametrize("waiting", [False, True])
def test_a_tick_after_a_stall_gives_poses_time_to_arrive(waiting, monkeypatch):
    """All processes stood still: the loop, which woke up first, took poses for lost
    that were a millisecond away. By a clock of the test's own.
    """
    links = Hovering()
    stall = 0.07
    clock = SimpleNamespace(now=10.0)
    waited = []

    def wait(until):
        waited.append(until)
        if len(waited) == 1 + waiting:
            links.now = clock.now  # a pose arrives
        else:
            clock.now += stall

    monkeypatch.setattr(ticks, "perf_counter", lambda: clock.now)
    links.wait = wait
    links.now = clock.now - stall * (not waiting)
    await_poses(links, links.now + (0.008 if waiting else 0.06))
    assert len(waited) == 1 + waiting and waited[-1] - links.now <= PATIENCE + 1e-9
