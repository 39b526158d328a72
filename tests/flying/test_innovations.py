"""Estimates that go wrong so gently that no single pose shows it, of a vehicle that
does what its thrust, attitude and body rates say.
"""

import math
import random

import pytest

from openjax.flying.controller import Pose, lift_acceleration, nominal_airframe, turned_on
from openjax.flying.innovations import Innovations, turn_between
from openjax.flying.judge import Verdict
from openjax.flying.safety import step
from openjax.flying.set_point import RATES, SetPoint
from openjax.flying.state import Drone, Event, Mode, PoseSample, Request, initial_state

AIRFRAME = nominal_airframe()
DT = 0.01
BEGIN = 2.0
"""s, when something goes wrong"""


def flight(seconds=6.0, push=(0.0, 0.0, 0.0)):
    """(pose, set-point) of a vehicle that rolls, pitches and climbs to and fro; `push`:
    what else accelerates it (m/s^2).
    """
    quaternion = (1.0, 0.0, 0.0, 0.0)
    position = (0.0, 0.0, 0.5)
    velocity = rates = (0.0, 0.0, 0.0)
    for k in range(round(seconds / DT)):
        t = k * DT
        lift = 1.0 + 0.1 * math.sin(5.0 * t)
        swing = 0.8 * math.cos(3.0 * t)
        yield (
            Pose(t, position, velocity, quaternion, rates),
            SetPoint(RATES, swing, -swing, 0.0, lift * AIRFRAME.hover_thrust),
        )
        rates = (swing, -swing, 0.0)
        quaternion = turned_on(quaternion, rates, DT)
        acceleration = lift_acceleration(quaternion, lift)
        faster = tuple(
            v + DT * (a + p) for v, a, p in zip(velocity, acceleration, push, strict=True)
        )
        position = tuple(
            p + DT * (v + w) / 2 for p, v, w in zip(position, velocity, faster, strict=True)
        )
        velocity = faster


def judged(damage=lambda pose, t, held, noise: pose, push=(0.0, 0.0, 0.0)):
    """(verdict, s after something went wrong) of the first contradiction; (good, None)
    for none.
    """
    innovations = Innovations()
    noise = random.Random(0).gauss
    held = None
    sent = SetPoint()
    for pose, following in flight(push=push):
        if pose.time >= BEGIN:
            held = held or pose
            pose = damage(pose, pose.time - BEGIN, held, noise)
        innovations = innovations.update(pose, sent, AIRFRAME)
        sent = following
        if verdict := innovations.verdict():
            return verdict, pose.time - BEGIN
    return Verdict.GOOD, None


def shaken(pose, t, held, noise):
    """As an estimator errs: 2 mm, 2 cm/s, a tenth of a degree, 2 degrees a second."""
    size = {"position": 2e-3, "velocity": 2e-2, "quaternion": 1e-3, "body_rates": 4e-2}
    return pose._replace(
        **{
            name: tuple(value + noise(0.0, error) for value in getattr(pose, name))
            for name, error in size.items()
        }
    )


@pytest.mark.parametrize("push", [(0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (0.0, 0.0, -1.2)])
def test_noise_wind_and_another_weight_are_no_contradiction(push):
    assert judged(shaken, push) == (Verdict.GOOD, None)


def drifting(speed, axis, velocity=0.0):
    def damage(pose, t, held, noise):
        position = list(pose.position)
        moving = list(pose.velocity)
        position[axis] += speed * t
        moving[axis] += velocity
        return pose._replace(position=tuple(position), velocity=tuple(moving))

    return damage


def frozen(pose, t, held, noise):
    return held._replace(
        time=pose.time,
        position=tuple(p + noise(0.0, 2e-3) for p in held.position),
        velocity=tuple(v + noise(0.0, 5e-3) for v in held.velocity),
    )


def tilting(pose, t, held, noise):
    return pose._replace(quaternion=turned_on(pose.quaternion, (0.15, 0.0, 0.0), t))


@pytest.mark.parametrize(
    "damage, verdict, within",
    [
        (drifting(0.3, axis=0), Verdict.NOT_ITS_WAY, 0.4),
        (drifting(0.1, axis=2), Verdict.NOT_ITS_WAY, 2.0),
        (drifting(0.3, axis=1, velocity=0.3), Verdict.NOT_ITS_THRUST, 0.02),
        (drifting(-0.3, axis=2, velocity=-0.3), Verdict.NOT_ITS_THRUST, 0.02),
        (frozen, None, 0.5),
        (tilting, Verdict.NOT_ITS_TURN, 1.0),
        (
            lambda pose, t, held, noise: pose._replace(body_rates=(0.0, 0.0, 3.0)),
            Verdict.NOT_ITS_TURN,
            0.3,
        ),
    ],
)
def test_what_drifts_freezes_or_tilts_is_told_before_it_is_far(damage, verdict, within):
    told, after = judged(damage)
    assert told and (verdict is None or told is verdict)
    assert after <= within


def test_the_pose_that_is_flown_on_by_is_without_the_drift():
    innovations = Innovations()
    for pose, sent in flight(2.0):
        moved = drifting(0.08, axis=0)(pose, pose.time, None, None)
        innovations = innovations.update(moved, sent, AIRFRAME)
    assert abs(moved.position[0] - pose.position[0]) > 0.15
    assert abs(innovations.corrected_pose().position[0] - moved.position[0]) > 0.06


def test_a_turn_between_attitudes_is_the_rotation_between_them():
    before = turned_on((1.0, 0.0, 0.0, 0.0), (0.5, -1.0, 2.0), 0.3)
    turn = turn_between(before, turned_on(before, (1.0, 2.0, -3.0), 0.01))
    assert turn == pytest.approx((0.01, 0.02, -0.03), rel=1e-3)


def test_a_flight_by_own_estimates_alone_ends_in_time_and_one_that_is_confirmed_doesnt():
    state = initial_state([(0.0, 0.0, 0.5)])
    for captured in (False, True):
        flown = state._replace(drones=(Drone(Mode.HOLD, anchor=(0.0, 0.0, 0.5)),))
        for k in range(4200):
            now = k * DT
            shake = 1e-4 * math.sin(997.0 * now)
            pose = Pose(now, (shake, 0.0, 0.5), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            sample = PoseSample(pose, now, 4.0, captured=pose if captured else None)
            flown, _ = step(flown, Event(now, (sample,), request=Request.NONE))
        (drone,) = flown.drones
        assert (drone.mode is Mode.HOLD) == captured
        assert captured or drone.reason == "40 s by its own estimate alone"
