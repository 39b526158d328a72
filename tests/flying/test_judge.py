"""Poses judged: what no vehicle can have done isn't believed, what one can is; and
nothing wrong reaches the game.
"""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openjax.flying.controller import Pose, moved_on, nominal_airframe
from openjax.flying.judge import Verdict, judge, offset_of
from openjax.flying.set_point import MOTORS_OFF
from openjax.flying.sources import PoseSource, VehicleTick
from openjax.flying.state import initial_state

LIMITS = initial_state([], airframe=nominal_airframe()).limits
LEVEL = (1.0, 0.0, 0.0, 0.0)
HERE = Pose(0.0, (0.4, 0.0, 0.5), (0.3, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.1))


def turned(angle, axis=3):
    return tuple(
        math.cos(angle / 2) if i == 0 else math.sin(angle / 2) if i == axis else 0.0
        for i in range(4)
    )


@pytest.mark.parametrize("field", ["position", "velocity", "quaternion", "body_rates"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_refused_in_every_field(field, bad):
    for k in range(len(getattr(HERE, field))):
        values = list(getattr(HERE, field))
        values[k] = bad
        assert (
            judge(HERE._replace(**{field: tuple(values)}), None, 0.0, LIMITS) is Verdict.NOT_FINITE
        )


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, Verdict.NO_ATTITUDE),
        ({"quaternion": (1.1, 0.0, 0.0, 0.0)}, Verdict.NO_ATTITUDE),
        ({"body_rates": (0.0, 40.0, 0.0)}, Verdict.SPUN),
        ({"position": (0.54, 0.0, 0.5)}, Verdict.JUMPED),  # .14 m: one wrong frame
        ({"position": (2.4, 0.0, 0.5)}, Verdict.JUMPED),
        ({"velocity": (1.5, 0.0, 0.0)}, Verdict.TOO_FAST),
        ({"quaternion": turned(math.pi)}, Verdict.TURNED),
        ({"quaternion": turned(math.pi / 2, 1)}, Verdict.TURNED),
        ({"position": (0.403, 1e-4, 0.5)}, Verdict.GOOD),
        ({}, Verdict.FROZEN),
    ],
)
def test_one_wrong_frame(changes, verdict):
    assert judge(HERE._replace(time=0.01, **changes), HERE, 0.01, LIMITS) is verdict


@pytest.mark.parametrize(
    ("x", "unseen", "verdict"),
    [(1.2, 0.01, Verdict.JUMPED), (1.2, 0.3, Verdict.GOOD), (3.0, 0.3, Verdict.JUMPED)],
)
def test_a_vehicle_gets_farther_while_nothing_is_heard_than_while_it_is_landed_by_reckoning(
    x, unseen, verdict
):
    """.8 m away after .3 s: the last of many wrong poses, or the first one after a
    radio's outage.
    """
    assert judge(HERE._replace(time=0.3, position=(x, 0.0, 0.5)), HERE, unseen, LIMITS) is verdict


unit = st.floats(-1.0, 1.0)


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit), st.floats(0.001, 0.5))
def test_what_a_vehicle_can_do_is_believed(push, spin, dt):
    """Any acceleration of thrust and gravity, any angular acceleration of its rotors,
    for any time in which nothing is heard.
    """
    thrust = tuple(
        9.81 / nominal_airframe().hover_thrust * a / max(math.hypot(*push), 1.0) for a in push
    )
    acceleration = (*thrust[:2], thrust[2] - 9.81)
    alpha = [
        nominal_airframe().angular_acceleration * a / max(math.hypot(*spin), 1.0) for a in spin
    ]
    drawn = HERE._replace(
        body_rates=tuple(0.5 * dt * a for a in alpha)
    )  # the mean rates of the way
    there = moved_on(drawn, dt)
    there = there._replace(
        position=tuple(
            p + dt * v + 0.5 * dt**2 * a
            for p, v, a in zip(HERE.position, HERE.velocity, acceleration, strict=True)
        ),
        velocity=tuple(v + dt * a for v, a in zip(HERE.velocity, acceleration, strict=True)),
        body_rates=tuple(dt * a for a in alpha),
    )
    still = HERE._replace(body_rates=(0.0, 0.0, 0.0))
    verdict = judge(there, still, dt, LIMITS)
    assert verdict is Verdict.GOOD or (
        verdict is Verdict.SPUN and math.hypot(*there.body_rates) > LIMITS.body_rate
    )


def moment(time, moving=True):
    return VehicleTick(time, LIMITS, nominal_airframe(), MOTORS_OFF, moving, airborne=False)


def test_poses_out_of_order_late_or_from_the_future_change_nothing():
    source = PoseSource(HERE._replace(time=1.0))
    for time in (0.99, 1.0, 0.5, 1.2, math.nan, math.inf):
        pose = HERE._replace(time=time, position=(0.401, 0.0, 0.5))
        assert source.update(pose, moment(1.01), None) is source
    assert PoseSource().update(None, moment(1.0), None) == PoseSource()


def test_a_refused_pose_leaves_the_last_good_one():
    wrong = HERE._replace(time=0.01, position=(2.0, 0.0, 0.5))
    refused = PoseSource(HERE).update(wrong, moment(0.01), None)
    assert refused == PoseSource(HERE, Verdict.JUMPED, 0.01)
    # carried to another place by hand
    assert PoseSource(HERE).update(wrong, moment(0.01, moving=False), None).pose is wrong


def test_agreement_is_of_place_and_attitude_at_one_time():
    fast = replace_velocity(HERE, (2.0, 0.0, 0.0))
    assert offset_of(fast, moved_on(fast, 0.05)).is_agreement(LIMITS)
    aside = offset_of(HERE, HERE._replace(position=(0.55, 0.0, 0.5)))
    turned_away = offset_of(HERE, HERE._replace(quaternion=turned(math.pi)))
    assert not aside.is_agreement(LIMITS) and not turned_away.is_agreement(LIMITS)
    scaled = replace(LIMITS, apart=0.05)
    assert not offset_of(HERE, HERE._replace(position=(0.48, 0.0, 0.5))).is_agreement(scaled)


def test_the_estimator_on_board_isnt_told_what_it_cant_have_missed():
    near, far = (HERE._replace(position=(0.4 + d, 0.0, 0.5)) for d in (0.02, 0.06))
    assert offset_of(HERE, near).is_error(LIMITS) and not offset_of(HERE, far).is_error(LIMITS)
    assert offset_of(far, HERE).is_agreement(LIMITS)  # it is flown by all the same
    assert offset_of(HERE, moved_on(HERE, 0.2)).is_error(LIMITS)


def replace_velocity(pose, velocity):
    return pose._replace(velocity=velocity)
