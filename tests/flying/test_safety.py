"""The state machine: rules one by one, properties under any events, and faults flown in simulated time."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.flying_faults import KINDS, fly, summary
from openjax.flying.controller import Airframe, Pose
from openjax.flying.limits import SafetySettings, fence_velocity, resting_places
from openjax.flying.safety import (
    Drone,
    Event,
    Mode,
    Request,
    Sighting,
    initial_state,
    step,
)
from openjax.flying.set_point import OFF, RATES, SetPoint

LIMITS = SafetySettings()
LEVEL = (1.0, 0.0, 0.0, 0.0)
PLACES = ((0.5, 0.3, 0.5), (0.5, 0.0, 0.5), (0.5, -0.3, 0.5))
POLICY = SetPoint(RATES, 0.1, 0.2, 0.3, 0.6)


def pursuing():
    state = initial_state(PLACES)
    drones = tuple(Drone(Mode.PURSUIT, estimate=Pose(0.0, p, (0, 0, 0), LEVEL)) for p in PLACES)
    return replace(state, drones=drones)


def event(time=0.01, request=Request.NONE, actions=(POLICY,) * 3, **changed):
    seen = [Sighting(Pose(time, p, (0.0, 0.0, 0.0), LEVEL), time, 4.0) for p in PLACES]
    for i, sighting in changed.items():
        seen[int(i[1:])] = sighting
    return Event(time, tuple(seen), actions, request)


def test_the_policy_flies_while_all_is_well():
    state, out = step(LIMITS, pursuing(), event())
    assert out == (POLICY,) * 3
    assert state.all_in(Mode.PURSUIT)


def test_a_lost_pose_lands_that_one_blindly_and_stops_the_others():
    state = pursuing()
    for k in range(1, 12):
        old = Sighting(Pose(0.0, PLACES[1], (0.4, 0.0, 0.0), LEVEL), 0.01 * k, 4.0)
        state, out = step(LIMITS, state, event(0.01 * k, _1=old))
    assert state.modes == (Mode.HOLD, Mode.BLIND, Mode.HOLD)
    assert out[1].mode != RATES and out[1].thrust < Airframe().hover_thrust
    assert out[1].pitch < 0.0  # it brakes
    k0 = state.time
    for k in range(1, 130):
        old = Sighting(Pose(0.0, PLACES[1], (0.4, 0.0, 0.0), LEVEL), k0 + 0.01 * k, 4.0)
        state, _ = step(LIMITS, state, event(k0 + 0.01 * k, _1=old))
    assert state.modes[0] is Mode.LAND and state.modes[2] is Mode.LAND


@pytest.mark.parametrize(("ticks", "mode"), [(4, Mode.PURSUIT), (40, Mode.BLIND)])
def test_a_pose_that_jumps_is_not_followed(ticks, mode):
    """Motion capture takes the vehicle for another: for a moment nothing happens, for longer it lands where it is."""
    state, away = pursuing(), (0.1, 0.0, 0.5)
    for k in range(1, 3):
        state, _ = step(LIMITS, state, event(0.01 * k))
    for k in range(3, 3 + ticks):
        time = 0.01 * k
        state, _ = step(
            LIMITS, state, event(time, _1=Sighting(Pose(time, away, (0.0,) * 3, LEVEL), time, 4.0))
        )
    assert math.dist(state.drones[1].estimate.position[:2], PLACES[1][:2]) < 0.02
    assert state.modes[1] is mode
    assert state.drones[1].reason == ("pose jumped" if mode is Mode.BLIND else "")
    time = state.time + 0.01
    back = Sighting(Pose(time, PLACES[1], (0.0,) * 3, LEVEL), time, 4.0)
    state, _ = step(LIMITS, state, event(time, _1=back))
    assert state.modes[1] is (Mode.LAND if mode is Mode.BLIND else Mode.PURSUIT)


@pytest.mark.parametrize(
    ("sighting", "reason"),
    [
        (Sighting(Pose(0.01, (0.5, 0.0, 0.5), (3.0, 0.0, 0.0), LEVEL), 0.01, 4.0), "too fast"),
        (Sighting(Pose(0.01, (1.3, 0.0, 0.5), (0.0, 0.0, 0.0), LEVEL), 0.01, 4.0), "outside the arena"),
        (Sighting(Pose(0.01, (0.5, 0.0, 0.5), (0.0,) * 3, (0.6, 0.8, 0.0, 0.0)), 0.01, 4.0), "too tilted"),
        (Sighting(Pose(0.01, (math.nan, 0.0, 0.5), (0.0,) * 3, LEVEL), 0.01, 4.0), "pose lost"),
    ],
)
def test_what_is_out_of_limits_ends_the_game_for_all(sighting, reason):
    state, _ = step(LIMITS, pursuing(), event(_1=sighting))
    assert state.drones[1].reason == reason
    assert not any(mode is Mode.PURSUIT for mode in state.modes)


def test_a_battery_must_be_low_for_a_while():
    state = pursuing()
    for k in range(1, 70):
        low = Sighting(Pose(0.01 * k, PLACES[0], (0.0,) * 3, LEVEL), 0.01 * k, 3.0)
        state, _ = step(LIMITS, state, event(0.01 * k, _0=low))
        assert (state.modes[0] is Mode.PURSUIT) == (0.01 * (k - 1) <= LIMITS.battery_time)


def test_without_actions_all_wait_and_then_land():
    state = pursuing()
    for k in range(1, 8):
        state, out = step(LIMITS, state, event(0.01 * k, actions=None))
    assert state.all_in(Mode.HOLD) and all(o.mode != OFF for o in out)


def test_the_stop_key_stops_all_for_good():
    state, out = step(LIMITS, pursuing(), event(request=Request.STOP))
    assert out == (SetPoint(),) * 3
    state, out = step(LIMITS, state, event(0.02, request=Request.TRANSFER))
    assert out == (SetPoint(),) * 3 and state.all_in(Mode.STOPPED)


def test_resting_places_are_inside_apart_and_off_the_pillars():
    near = [(0.85, 0.05, 0.1), (0.86, 0.0, 1.19), (0.45, 0.12, 0.5)]
    poses = [Pose(0.0, p, (0.6, 0.0, 0.3), LEVEL) for p in near]
    places = resting_places(LIMITS, [(0.5, 0.1, 0.1)], poses)
    for i, (x, y, z) in enumerate(places):
        assert math.hypot(x, y) < LIMITS.arena_radius - 0.1
        assert 0.25 < z < LIMITS.arena_height - 0.25
        assert math.hypot(x - 0.5, y - 0.1) > 0.2
        assert all(math.dist(places[i][:2], places[j][:2]) > 0.25 for j in range(i))


def test_the_fence_turns_back_what_could_not_stop_any_more():
    assert fence_velocity(LIMITS, Pose(0.0, (0.6, 0.0, 0.5), (0.3, 0.0, 0.0), LEVEL)) is None
    back = fence_velocity(LIMITS, Pose(0.0, (0.8, 0.0, 0.5), (1.0, 0.0, 0.0), LEVEL))
    assert back[0] < 0.0


numbers = st.floats(-3.0, 3.0)
poses = st.builds(
    lambda age, p, v, q: (age, p, v, q),
    st.floats(0.0, 0.3),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers),
    st.sampled_from([LEVEL, (0.8, 0.6, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (math.nan,) * 4, (0.0,) * 4]),
)
ticks = st.tuples(
    st.lists(st.tuples(st.none() | poses, st.floats(0.0, 1.0), st.floats(2.0, 4.2)), min_size=3, max_size=3),
    st.booleans(),
    st.sampled_from([*[Request.NONE] * 6, *Request]),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(ticks, min_size=1, max_size=25))
def test_any_events_give_finite_set_points_and_ends_are_ends(events):
    state, now = pursuing(), 0.0
    for seen, acts, request in events:
        now += 0.01
        sightings = tuple(
            Sighting(None if pose is None else Pose(now - pose[0], *pose[1:]), now - silent, voltage)
            for pose, silent, voltage in seen
        )
        over = [mode in (Mode.STOPPED,) for mode in state.modes]
        happened = Event(now, sightings, (POLICY,) * 3 if acts else None, request)
        after, out = step(LIMITS, state, happened)
        assert step(LIMITS, state, happened) == (after, out) or any(map(math.isnan, _numbers(after)))
        state = after
        for i, o in enumerate(out):
            assert all(map(math.isfinite, (o.roll, o.pitch, o.yaw_rate, o.thrust)))
            assert -0.01 <= o.thrust < 1.6
            if over[i]:
                assert o.mode == OFF
            if state.modes[i] in (Mode.LANDED, Mode.STOPPED, Mode.GROUND):
                assert o.mode == OFF


def _numbers(state):
    return [x for d in state.drones if d.estimate is not None for x in d.estimate.position]


def test_every_kind_of_fault_ends_on_the_floor_inside():
    records = fly(list(range(2 * len(KINDS))), "wall", "no_clamp_seed_0", latest=1.2, seconds=6.5)
    for row in summary(records):
        assert row["landed"] == row["inside"] == row["vehicles"], row
        assert row["hard"] == 0 and row["farthest"] < 1.0, row
