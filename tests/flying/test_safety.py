"""The state machine: rules one by one, and properties under any events."""

import math
import multiprocessing
import socket
import sys
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.flying.board import Board, Role
from openjax.flying.controller import Pose, accelerate, nominal_airframe, roll_pitch_yaw
from openjax.flying.limits import fence_velocity, parting_velocity, resting_places, stopping_point
from openjax.flying.safety import step
from openjax.flying.set_point import OFF, RATES, SetPoint, from_action
from openjax.flying.sources import PoseSource
from openjax.flying.state import (
    Drone,
    Event,
    Mode,
    PoseSample,
    Request,
    SafetySettings,
    initial_state,
)
from openjax.flying.takeover import fly_down, take_over

LIMITS = SafetySettings()
LEVEL = (1.0, 0.0, 0.0, 0.0)
PLACES = ((0.5, 0.3, 0.5), (0.5, 0.0, 0.5), (0.5, -0.3, 0.5))
POLICY = SetPoint(RATES, 0.1, 0.2, 0.3, 0.6)


def still(time, place, velocity=(0.0, 0.0, 0.0), quaternion=LEVEL):
    """A pose of a vehicle that hovers, with a measurement's noise: no two are
    identical.
    """
    return Pose(time, (place[0] + 1e-4 * math.sin(1e3 * time), *place[1:]), velocity, quaternion)


def pursuing(velocity=(0.0, 0.0, 0.0)):
    state = initial_state(PLACES)
    poses = [Pose(0.0, p, velocity, LEVEL) for p in PLACES]
    drones = tuple(
        Drone(Mode.PURSUIT, estimate=p, own=PoseSource(p), seen=0.0, sent=POLICY) for p in poses
    )
    return state._replace(drones=drones)


def event(time=0.01, request=Request.NONE, actions=(POLICY,) * 3, **changed):
    seen = [PoseSample(still(time, p), time, 4.0) for p in PLACES]
    for i, sighting in changed.items():
        seen[int(i[1:])] = sighting
    return Event(time, tuple(seen), actions, request)


def test_the_policy_flies_while_all_is_well():
    state, out = step(pursuing(), event())
    assert out == (POLICY,) * 3
    assert state.all_in(Mode.PURSUIT)


def test_who_takes_over_knows_where_vehicles_have_got_to():
    board = Board(3, multiprocessing.get_context("spawn"))
    state = pursuing((0.4, 0.0, 0.0))
    turning = state.drones[0]._replace(
        estimate=state.drones[0].estimate._replace(body_rates=(2.0, 0.0, 0.0))
    )
    board.write(Role.LOOP, 0.0, state._replace(drones=(turning, *state.drones[1:])))
    first, second, _ = take_over(board.read(initial_state(PLACES), 0.1), 0.1).drones
    assert (
        first.estimate.position[0]
        == second.estimate.position[0]
        == pytest.approx(PLACES[0][0] + 0.04)
    )
    assert roll_pitch_yaw(first.estimate.quaternion)[0] == pytest.approx(0.2, abs=1e-2)
    assert first.mode is second.mode is Mode.HOLD


class Still:
    """Links to vehicles that stay where they are, whatever they are told."""

    def __init__(self):
        self.sent = []

    def observe(self):
        now = time.perf_counter()
        return tuple(PoseSample(still(now, p), now, 4.0, supervisor=0) for p in PLACES)

    def send(self, set_points):
        self.sent.append([s.mode for s in set_points])

    def arm(self, on):
        assert not on


@pytest.mark.parametrize("role", Role)
def test_a_stop_is_heard_by_whoever_lands(role):
    """By the loop, too: it has the keys, and once it lands by itself nobody else asks
    for them.
    """
    board = Board(3, multiprocessing.get_context("spawn"), silence=0.01)
    links = Still()
    board.write(Role.LOOP, time.perf_counter(), pursuing())

    def listen():
        board.stopped = len(links.sent) == 5

    last = fly_down(board, role, links, initial_state(PLACES), listen)
    assert last.all_in(Mode.STOPPED)
    assert all(OFF not in modes for modes in links.sent[:5]) and links.sent[5] == [OFF] * 3


DONGLE = "\0openjax test of a dongle"


def hold(board, ready):
    """Have what only one process can have, until killed, which takes a while with so
    much memory to give back.
    """
    held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    held.bind(DONGLE)
    board.enter(Role.LINKS)
    memory = b"x" * (1 << 28)
    ready.set()
    time.sleep(60.0 + len(memory))


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="Linux's abstract names, and pidfd"
)
def test_what_an_ended_process_held_is_free():
    """A radio dongle is one process's: who takes over opens it right after."""
    context = multiprocessing.get_context("spawn")
    board = Board(1, context, silence=5.0)
    ready = context.Event()
    holder = context.Process(target=hold, args=(board, ready))
    holder.start()
    try:
        assert ready.wait(60.0)
        board.end_process(Role.LINKS)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as free:
            free.bind(DONGLE)
    finally:
        holder.kill()
        holder.join()


def test_a_lost_pose_lands_that_one_by_reckoning_and_stops_the_others():
    state = pursuing((0.4, 0.0, 0.0))
    for k in range(1, 12):
        old = PoseSample(Pose(0.0, PLACES[1], (0.4, 0.0, 0.0), LEVEL), 0.01 * k, 4.0)
        state, out = step(state, event(0.01 * k, _1=old))
    assert state.modes == (Mode.HOLD, Mode.LAND, Mode.HOLD)
    assert out[1].mode != RATES and out[1].thrust < nominal_airframe().hover_thrust
    assert out[1].pitch < 0.0  # it brakes
    k0 = state.time
    for k in range(1, 130):
        old = PoseSample(Pose(0.0, PLACES[1], (0.4, 0.0, 0.0), LEVEL), k0 + 0.01 * k, 4.0)
        state, _ = step(state, event(k0 + 0.01 * k, _1=old))
    assert state.modes[0] is Mode.LAND and state.modes[2] is Mode.LAND


@pytest.mark.parametrize(("ticks", "mode"), [(4, Mode.PURSUIT), (40, Mode.LAND)])
def test_a_pose_that_jumps_is_not_followed(ticks, mode):
    """Motion capture takes the vehicle for another: for a moment nothing happens, for
    longer it lands where it is.
    """
    state = pursuing()
    away = (0.1, 0.0, 0.5)
    for k in range(1, 3):
        state, _ = step(state, event(0.01 * k))
    for k in range(3, 3 + ticks):
        time = 0.01 * k
        state, _ = step(
            state, event(time, _1=PoseSample(Pose(time, away, (0.0,) * 3, LEVEL), time, 4.0))
        )
    assert math.dist(state.drones[1].estimate.position[:2], PLACES[1][:2]) < 0.02
    assert state.modes[1] is mode
    assert state.drones[1].reason == ("pose jumped" if mode is Mode.LAND else "")
    time = state.time + 0.01
    back = PoseSample(still(time, PLACES[1]), time, 4.0)
    state, _ = step(state, event(time, _1=back))
    assert state.modes[1] is mode


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("off", [0.14, 2.0])
def test_wrong_frames_of_motion_capture_move_nothing(frames, off):
    """Velocities are differences of its positions: a frame that isn't refused in time
    is a velocity of metres a second.
    """
    state = pursuing()
    place = PLACES[1]
    for k in range(1, 30):
        time = 0.01 * k
        wrong = 10 <= k < 10 + frames
        seen = still(time, (place[0] + off * wrong, *place[1:]))
        sample = PoseSample(still(time, place), time, 4.0, captured=seen)
        state, _ = step(state, event(time, _1=sample))
        assert math.dist(state.drones[1].estimate.position, place) < 0.01
        assert math.hypot(*state.drones[1].estimate.velocity) < 0.05
    assert state.all_in(Mode.PURSUIT)


def test_an_own_estimate_that_is_elsewhere_is_not_believed_for_having_waited():
    """With time it might have drifted there by reckoning; motion capture sees that it
    hasn't.
    """
    state = pursuing()
    away = (0.5, 0.6, 0.5)
    for k in range(1, 150):
        now = 0.01 * k
        own = still(now, PLACES[0] if k < 5 else away)
        sample = PoseSample(own, now, 4.0, captured=still(now, PLACES[0]))
        state, _ = step(state, event(now, s0=sample))
        estimate = state.drones[0].estimate
        assert math.dist(estimate.position, PLACES[0]) < 0.05 and not state.drones[0].captured.fault


def test_the_estimator_on_board_is_told_what_is_near_it_and_no_more():
    state = pursuing()
    told = []
    for k in range(1, 41):
        time = 0.01 * k
        place = PLACES[1]
        seen = still(time, (place[0] + 0.0012 * k, *place[1:]))
        sample = PoseSample(still(time, place), time, 4.0, captured=seen)
        state, _ = step(state, event(time, _1=sample))
        told.append(state.drones[1].feeds_estimator)
    assert state.all_in(Mode.PURSUIT) and all(told[:15]) and not any(told[-10:])


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (Pose(0.0, PLACES[1], (3.0, 0.0, 0.0), LEVEL), "too fast"),
        (Pose(0.0, (1.3, 0.0, 0.5), (0.0, 0.0, 0.0), LEVEL), "outside the arena"),
        (Pose(0.0, PLACES[1], (0.0,) * 3, (0.6, 0.8, 0.0, 0.0)), "too tilted"),
    ],
)
def test_what_is_out_of_limits_ends_the_game_for_all(pose, reason):
    state = pursuing()
    drone = state.drones[1]._replace(own=PoseSource(pose), estimate=pose)
    state = state._replace(drones=(state.drones[0], drone, state.drones[2]))
    seen = pose._replace(
        time=0.01, position=(pose.position[0] + 0.01 * pose.velocity[0] + 1e-4, *pose.position[1:])
    )
    state, _ = step(state, event(_1=PoseSample(seen, 0.01, 4.0)))
    assert state.drones[1].reason == reason
    assert not any(mode is Mode.PURSUIT for mode in state.modes)


@pytest.mark.parametrize("error", [-0.35, 0.0, 0.05])
def test_a_landing_is_soft_where_the_floor_isnt_where_it_is_thought(error):
    """A point mass on the floor of closed form: the estimate's height is wrong by
    `error` (m) from the landing on.
    """
    state = pursuing()
    height = 0.5
    speed = 0.0
    touched = []
    for k in range(1, 600):
        time = 0.01 * k
        seen = still(time, (*PLACES[1][:2], height + error * min(k / 100, 1.0)), (0.0, 0.0, speed))
        request = Request.LAND if k == 1 else Request.NONE
        state, out = step(state, event(time, request, _1=PoseSample(seen, time, 4.0)))
        speed += 0.01 * 9.81 * (out[1].thrust / nominal_airframe().hover_thrust - 1.0)
        height += 0.01 * speed
        if height < 0.0:
            touched.append(speed)
            height = speed = 0.0
    assert state.modes[1] is Mode.LANDED and -1.2 < touched[0] < -0.1


def test_who_leans_the_wrong_way_turns_before_it_pushes():
    """Leaning 45 degrees outwards and asked to brake, full thrust would drive it
    out.
    """
    lean = (math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0)
    hover = nominal_airframe().hover_thrust
    thrust = [
        accelerate(q, (-5.0, 0.0, 0.0), nominal_airframe(), 0.0).thrust for q in (LEVEL, lean)
    ]
    assert thrust[0] == pytest.approx(hover)
    assert thrust[1] == pytest.approx(hover * (9.81 - 5.0) / 9.81 * math.sqrt(0.5))


def test_upside_down_for_long_its_motors_are_off_and_the_others_land():
    state = pursuing()
    over = (0.1, 0.995, 0.0, 0.0)
    drone = state.drones[1]._replace(own=PoseSource(Pose(0.0, PLACES[1], (0.0,) * 3, over)))
    state = state._replace(drones=(state.drones[0], drone, state.drones[2]))
    for k in range(1, 20):
        seen = PoseSample(still(0.01 * k, PLACES[1], quaternion=over), 0.01 * k, 4.0)
        state, out = step(state, event(0.01 * k, _1=seen))
    assert state.modes[1] is Mode.STOPPED and state.drones[1].reason == "tumbled"
    assert out[1].mode == OFF and out[0].mode != OFF


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_action_that_is_no_number_is_none(bad):
    state = pursuing()
    for k in range(1, 8):
        actions = (POLICY, from_action([0.0, bad, 0.0, 0.0], 1.0), POLICY)
        state, out = step(state, event(0.01 * k, actions=actions))
        assert all(math.isfinite(x) for o in out for x in o)
    assert state.all_in(Mode.HOLD) and state.drones[0].reason == "action not finite"


def test_vehicles_that_close_in_are_parted():
    """Two head on at 1 m/s each, as the policy wants; they brake at what is counted on,
    and stay apart.
    """
    places = [[-0.5, 0.0, 0.5], [0.5, 0.02, 0.5]]
    speeds = [1.0, -1.0]
    nearest = math.inf
    for _ in range(200):
        poses = [
            Pose(0.0, tuple(p), (v, 0.0, 0.0), LEVEL) for p, v in zip(places, speeds, strict=True)
        ]
        wanted = [parting_velocity(LIMITS, i, poses) for i in range(2)]
        for i in range(2):
            if wanted[i] is not None:
                change = min(max(wanted[i][0] - speeds[i], -0.05), 0.05)  # 5 m/s^2
                speeds[i] += change
            places[i][0] += 0.01 * speeds[i]
        nearest = min(nearest, math.dist(*places))
    assert nearest > 0.15


def lift(rise, seconds=2.5):
    """Modes and reasons after a test lift in which the vehicle's poses are rise(height
    of the others) (m).
    """
    state = initial_state(PLACES)
    height = 0.0
    for k in range(1, int(100 * seconds)):
        time = 0.01 * k
        seen = [(*p[:2], height) for p in PLACES]
        place, captured = rise(PLACES[1], height)
        samples = [PoseSample(still(time, p), time, 4.0) for p in seen]
        samples[1] = PoseSample(
            still(time, place), time, 4.0, captured=captured and still(time, captured)
        )
        request = Request.TRANSFER if k == 5 else Request.NONE
        state, _ = step(state, Event(time, tuple(samples), None, request))
        if any(m is Mode.LIFT for m in state.modes):
            height = min(height + 0.002, 0.1)
        if state.modes[1] not in (Mode.GROUND, Mode.LIFT):
            break
    return state


@pytest.mark.parametrize(
    ("rise", "word"),
    [
        (lambda p, h: ((*p[:2], h), None), ""),
        (lambda p, h: ((*p[:2], h), (*p[:2], h)), ""),
        (lambda p, h: ((p[0] + h, p[1], 0.0), None), "sideways"),  # y up
        (lambda p, h: ((*p[:2], 0.2 * h), None), "up after"),  # scale, weight
        (lambda p, h: ((*p[:2], 2.5 * h), None), "too high"),
        (lambda p, h: ((*p[:2], h), (*p[:2], 0.4 * h)), "differently"),
    ],
)
def test_the_test_lift_tells_poses_that_rise_otherwise(rise, word):
    state = lift(rise)
    assert (state.modes[1] is Mode.TRANSFER) == (not word)
    assert word in state.drones[1].reason
    if word:
        assert state.all_in(Mode.STOPPED)  # from ten centimetres


def test_a_battery_must_be_low_for_a_while():
    state = pursuing()
    for k in range(1, 70):
        low = PoseSample(still(0.01 * k, PLACES[0]), 0.01 * k, 3.0)
        state, _ = step(state, event(0.01 * k, _0=low))
        assert (state.modes[0] is Mode.PURSUIT) == (0.01 * (k - 1) <= LIMITS.battery_time)


def test_without_actions_all_wait_and_then_land():
    state = pursuing()
    for k in range(1, 8):
        state, out = step(state, event(0.01 * k, actions=None))
    assert state.all_in(Mode.HOLD) and all(o.mode != OFF for o in out)


def test_who_waits_because_it_was_asked_to_lands_with_one_in_trouble():
    state, _ = step(pursuing(), event(request=Request.HOLD))
    assert state.all_in(Mode.HOLD)
    for k in range(2, 130):
        low = PoseSample(still(0.01 * k, PLACES[0]), 0.01 * k, 3.0)
        state, _ = step(state, event(0.01 * k, _0=low))
    assert state.all_in(Mode.LAND)


@pytest.mark.parametrize("ceiling", [0.6, 1.2, 3.0])
def test_a_landing_by_reckoning_has_the_time_that_its_height_takes(ceiling):
    """With motors off before they would fall, in a high room from metres."""
    high = initial_state(PLACES, settings=SafetySettings(arena_height=ceiling))
    drones = tuple(
        Drone(Mode.PURSUIT, estimate=Pose(0.0, (*p[:2], ceiling), (0.0,) * 3, LEVEL), seen=0.0)
        for p in PLACES
    )
    state = high._replace(drones=drones)
    now = 0.0
    while not state.all_in(Mode.SETTLE):
        now += 0.01
        assert now < 20.0
        state, _ = step(state, Event(now, (PoseSample(None, now, 4.0),) * 3))
    assert all(drone.estimate.position[2] < 0.2 for drone in state.drones)


def test_the_stop_key_stops_all_for_good():
    state, out = step(pursuing(), event(request=Request.STOP))
    assert out == (SetPoint(),) * 3
    state, out = step(state, event(0.02, request=Request.TRANSFER))
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
    # estimates that agree to the last digit lead apart, too
    first, second = resting_places(LIMITS, [], [poses[2]] * 2)
    assert math.dist(first, second) > 0.25


def test_the_fence_turns_back_what_could_not_stop_any_more():
    assert fence_velocity(LIMITS, Pose(0.0, (0.6, 0.0, 0.5), (0.3, 0.0, 0.0), LEVEL)) is None
    back = fence_velocity(LIMITS, Pose(0.0, (0.8, 0.0, 0.5), (1.0, 0.0, 0.0), LEVEL))
    assert back[0] < 0.0
    # 35 degrees outwards must be undone first, 35 inwards brake already
    half = math.radians(17.5)
    outwards, inwards = ((math.cos(half), 0.0, sign * math.sin(half), 0.0) for sign in (1.0, -1.0))
    assert fence_velocity(LIMITS, Pose(0.0, (0.6, 0.0, 0.5), (1.0, 0.0, 0.0), outwards))[0] < 0.0
    assert fence_velocity(LIMITS, Pose(0.0, (0.65, 0.0, 0.5), (1.0, 0.0, 0.0), LEVEL)) is None
    assert fence_velocity(LIMITS, Pose(0.0, (0.7, 0.0, 0.5), (1.0, 0.0, 0.0), inwards)) is None


@given(st.floats(0.0, 3.0), st.floats(-5.0, 14.0))
def test_who_brakes_stops_before_the_point_that_the_fence_counts_on(speed, present):
    """Stepped in plain numbers: an acceleration that follows the braking with a lag."""
    counted_on = stopping_point(
        LIMITS, Pose(0.0, (0.0,) * 3, (speed, 0.0, 0.0), LEVEL), (present, 0.0, 0.0)
    )
    x = 0.0
    farthest = 0.0
    acceleration = present
    while speed > 0.0 or acceleration > 0.0:
        acceleration += 1e-3 / LIMITS.reaction * (-LIMITS.braking - acceleration)
        speed += 1e-3 * acceleration
        x += 1e-3 * speed
        farthest = max(farthest, x)
    assert farthest - 0.02 < max(counted_on[0], 0.0) < farthest + 0.1


numbers = st.floats(-3.0, 3.0)
poses = st.builds(
    lambda age, p, v, q: (age, p, v, q),
    st.floats(0.0, 0.3),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers),
    st.sampled_from(
        [LEVEL, (0.8, 0.6, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (math.nan,) * 4, (0.0,) * 4]
    ),
)
ticks = st.tuples(
    st.lists(
        st.tuples(st.none() | poses, st.floats(0.0, 1.0), st.floats(2.0, 4.2)),
        min_size=3,
        max_size=3,
    ),
    st.booleans(),
    st.sampled_from([*[Request.NONE] * 6, *Request]),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(ticks, min_size=1, max_size=25))
def test_any_events_give_finite_set_points_and_ends_are_ends(events):
    state = pursuing()
    now = 0.0
    for seen, acts, request in events:
        now += 0.01
        sightings = tuple(
            PoseSample(
                None if pose is None else Pose(now - pose[0], *pose[1:]), now - silent, voltage
            )
            for pose, silent, voltage in seen
        )
        over = [mode in (Mode.STOPPED,) for mode in state.modes]
        happened = Event(now, sightings, (POLICY,) * 3 if acts else None, request)
        after, out = step(state, happened)
        assert step(state, happened) == (after, out) or any(map(math.isnan, _numbers(after)))
        state = after
        for i, o in enumerate(out):
            assert all(map(math.isfinite, (o.roll, o.pitch, o.yaw_rate, o.thrust)))
            assert -0.01 <= o.thrust < 1.7
            if over[i]:
                assert o.mode == OFF
            if state.modes[i] in (Mode.LANDED, Mode.STOPPED, Mode.GROUND):
                assert o.mode == OFF


def _numbers(state):
    return [x for d in state.drones if d.estimate is not None for x in d.estimate.position]
