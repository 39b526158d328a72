"""A height that drifts gently, told by the accelerometer: of a vehicle that is pushed,
leans and climbs, and in a flight.
"""

import itertools

import pytest
from scipy.spatial.transform import Rotation

from openjax.flying.climb import BOUND, felt_climb
from openjax.flying.controller import GRAVITY, turned_on
from openjax.flying.innovations import Innovations
from openjax.flying.judge import Verdict
from tests.flying.test_innovations import AIRFRAME, DT, flight

PUSH = (0.5, 0.0, -0.8)
"""m/s^2, which thrust doesn't explain: the accelerometer feels it."""


def in_body(quaternion, vector):
    """A vector of the world in body axes."""
    return tuple(Rotation.from_quat(quaternion, scalar_first=True).inv().apply(vector).tolist())


def felt(pose, following):
    """The specific force (m/s^2, body) between two poses."""
    gain = [(b - a) / DT for a, b in zip(pose.velocity, following.velocity, strict=True)]
    gain[2] += GRAVITY
    return in_body(pose.quaternion, gain)


@pytest.fixture(scope="module")
def flown():
    """(pose, set-point, specific force) of six seconds, each with the force that has
    acted.
    """
    rows = list(flight(push=PUSH))
    forces = [felt(a[0], b[0]) for a, b in itertools.pairwise(rows)]
    return [(*row, force) for row, force in zip(rows[1:], forces, strict=False)]


def judged(rows, speed=0.0, axis=2, begin=0.3, logged=True):
    """The last innovations before the flight's end, or those that contradict the
    estimate, which drifts by `speed` (m/s) within 2 s from `begin` (s) on.
    """
    innovations = Innovations()
    way = 0.0
    for pose, sent, force in rows:
        drift = speed * min(max((pose.time - begin) / 2.0, 0.0), 1.0)
        way += DT * drift
        position = list(pose.position)
        velocity = list(pose.velocity)
        position[axis] += way
        velocity[axis] += drift
        told = pose._replace(position=tuple(position), velocity=tuple(velocity))
        innovations = innovations.update(told, sent, AIRFRAME, force=force if logged else None)
        if innovations.verdict():
            break
    return innovations, pose


def test_the_accelerometer_tells_its_climb_at_any_attitude():
    quaternion = turned_on((1.0, 0.0, 0.0, 0.0), (0.4, -0.7, 0.2), 1.0)
    force = in_body(quaternion, [1.0, 2.0, 3.0 + GRAVITY])
    assert felt_climb(quaternion, force) == pytest.approx(3.0, abs=1e-4)


@pytest.mark.parametrize("speed", [0.5, -0.5, 0.3])
def test_a_gentle_drift_of_the_height_is_told_early_and_undone(flown, speed):
    innovations, pose = judged(flown, speed)
    assert innovations.verdict() is Verdict.NOT_ITS_CLIMB
    assert pose.time < 2.8
    believed = innovations.corrected_pose()
    assert believed.position[2] == pytest.approx(pose.position[2], abs=0.06)
    assert believed.velocity[2] == pytest.approx(pose.velocity[2], abs=0.12)


def test_what_pushes_a_vehicle_is_no_drift_nor_is_anything_that_nobody_feels(flown):
    innovations, _ = judged(flown)
    assert not innovations.verdict() and abs(innovations.climb.smooth) < 0.3 * BOUND
    for options in ({"logged": False}, {"axis": 0}):
        assert judged(flown, 0.3, **options)[0].verdict() is Verdict.GOOD
