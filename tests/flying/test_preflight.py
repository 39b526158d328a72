"""Before take-off: each thing that must be so, wrong on its own, is one line that says
what to do.
"""

import math

import pytest

from openjax.flying.controller import Pose
from openjax.flying.crtp import Supervisor
from openjax.flying.preflight import faults, poses_arriving
from openjax.flying.state import PoseSample, initial_state

LEVEL = (1.0, 0.0, 0.0, 0.0)
STARTS = ((0.4, 0.2, 0.5), (0.4, -0.2, 0.5))
READY = Supervisor.CAN_BE_ARMED
AHEAD = math.sqrt(0.5)


def sample(x=0.4, y=0.2, z=0.0, quaternion=LEVEL, captured=None, voltage=4.1, bits=READY):
    pose = Pose(0.0, (x, y, z), (0.0,) * 3, quaternion)
    return PoseSample(
        pose, 0.0, voltage, bits, None if captured is None else pose._replace(position=captured)
    )


def found(first, rates=(100.0, 100.0), guarded=True):
    second = sample(0.4, -0.2)
    return faults(initial_state(STARTS), (first, second), rates, guarded)


def test_all_well_is_no_line():
    assert found(sample()) == []
    assert found(sample(bits=Supervisor.ARMED | Supervisor.AUTO_ARM | Supervisor.CAN_FLY)) == []
    assert found(sample(captured=(0.42, 0.2, 0.0))) == []


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (sample(0.4, 0.0, 0.2), "mark"),  # y up
        (sample(400.0, 200.0), "mark"),  # millimetres
        (sample(0.8, 0.4), "mark"),
        (sample(quaternion=(AHEAD, AHEAD, 0.0, 0.0)), "upright"),
        (sample(quaternion=(0.0, 0.0, 0.0, 1.0)), "+x"),
        (sample(x=math.nan), "finite"),
        (sample(quaternion=(0.0,) * 4), "attitude"),
        (sample(captured=(0.28, 0.2, 0.0)), "motion capture"),
        (sample(voltage=3.5), "charge"),
        (sample(voltage=math.nan), "charge"),
        (sample(bits=Supervisor.TUMBLED), "upright"),
        (sample(bits=Supervisor.LOCKED), "locked"),
        (sample(bits=Supervisor.ARMED | Supervisor.CAN_FLY), "already"),
        (sample(bits=Supervisor.FLYING | Supervisor.AUTO_ARM), "already"),
        (sample(bits=Supervisor(0)), "can't be armed"),
    ],
)
def test_what_is_wrong_is_one_line_with_what_to_do(wrong, word):
    (line,) = found(wrong)
    assert word in line and line.startswith("vehicle 0") and "\n" not in line


def test_link_and_guard():
    (line,) = found(sample(), rates=(100.0, 60.0))
    assert line.startswith("vehicle 1: 60 of 100 poses")
    (line,) = found(sample(), guarded=False)
    assert "guard" in line and "--" not in line  # not: fly without


def test_a_scaled_frame_is_told_by_the_vehicles_own():
    scaled = sample(0.6, 0.3)._replace(captured=Pose(0.0, (0.72, 0.36, 0.0), (0.0,) * 3, LEVEL))
    lines = faults(initial_state(((0.66, 0.33, 0.5),)), (scaled,), (100.0,), True)
    assert len(lines) == 1 and "unit" in lines[0]


class FullLinks:
    """Eight vehicles whose poses wait in a stream that holds so many; time is what
    somebody slept.
    """

    def __init__(self, room=270):
        self.counts = [0] * 8
        self.room = room
        self.now = 0.0
        self.waiting = []

    def sleep(self, seconds):
        first = round(100 * self.now)
        self.now += seconds
        for tick in range(first, round(100 * self.now)):
            poses = [(vehicle, 0.01 * tick) for vehicle in range(8)]
            self.waiting += poses[: self.room - len(self.waiting)]

    def observe(self):
        newest = [0.0] * 8
        for vehicle, time in self.waiting:
            self.counts[vehicle] += 1
            newest[vehicle] = time
        self.waiting = []
        return [
            PoseSample(Pose(time, (0.0,) * 3, (0.0,) * 3, LEVEL), 0.0, 4.1, READY, None)
            for time in newest
        ]


def test_poses_of_eight_vehicles_are_counted_though_few_can_wait(monkeypatch):
    links = FullLinks()
    monkeypatch.setattr("openjax.flying.preflight.time.sleep", links.sleep)
    links.sleep(20.0)  # nobody has read since they were connected
    assert poses_arriving(links) == pytest.approx([100.0] * 8, abs=2.1)
