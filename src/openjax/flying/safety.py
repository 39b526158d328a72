"""Safety of a flight as a pure state machine: what was seen in, set-points out.

`see(settings, state, time, samples)` judges the poses and brings each vehicle's estimate to now; `decide` says who flies
each vehicle: the policy, or the controller that lifts, waits and lands, at need by reckoning. `step` is both. Nothing here
reads a clock or touches a link, so that thousands of faults can be flown in simulated time.

A vehicle in trouble lands; all others stop where they are, wait a moment, and land too. Troubles: its pose is lost, its
link is silent, its battery low, it is too fast, too tilted, or outside the arena; no action came in time; a key.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from openjax.flying.controller import (
    Airframe,
    Pose,
    Vector,
    accelerate,
    level_acceleration,
    lift_acceleration,
    moved_on,
    nominal_airframe,
    turned_on,
    up,
    wanted_acceleration,
    wanted_velocity,
)
from openjax.flying.crtp import Supervisor
from openjax.flying.judge import (
    PoseLimits,
    Track,
    agree,
    at_one_time,
    follow,
    follows,
    pose_limits,
)
from openjax.flying.limits import (
    APART,
    SafetySettings,
    fence_velocity,
    parting_velocity,
    resting_places,
    within_reach,
)
from openjax.flying.set_point import ANGLES, LEAST_THRUST, MOTORS_OFF, RATES, SetPoint

LOW = 0.05
"""Below this height (m) a landing settles."""
SETTLING, SETTLING_LIFT = 0.75, 0.85
"""A landing ends level, with this share of its weight, for so long (s): from .4 m it comes down at 1.1 m/s. So far may the
floor be from where it is thought."""
SPIN_UP = 0.3
"""A vehicle that lifts off may stand still for so long (s)."""
ASIDE = 0.08
"""How far (m) a vehicle may move sideways in the test lift: a hover that starts beside its trim."""
RISEN = 0.04
"""The test lift is over this close (m) to its height."""
SMOOTHING = 0.02
"""Time constant of the low-pass of velocities from motion capture (s)."""
TRIM_GAIN, TRIM_LIMIT = 0.25, 0.15
_NOTHING_SEEN = Track()


class Mode(StrEnum):
    """Who flies a vehicle, and what it does."""

    GROUND = "ground"
    LIFT = "test lift"  # a hand's breadth, to see that poses rise as they should
    TRANSFER = "transfer"  # the way to where it is to start
    READY = "ready"
    PURSUIT = "pursuit"
    HOLD = "hold"
    LAND = "land"
    SETTLE = "settling"  # the last of a landing
    LANDED = "landed"
    STOPPED = "stopped"


LANDING = (Mode.LAND, Mode.SETTLE)
FLYING = (Mode.LIFT, Mode.TRANSFER, Mode.READY, Mode.PURSUIT, Mode.HOLD, *LANDING)
_DOWN = (Mode.GROUND, Mode.LANDED)
_UNTROUBLED = (Mode.LIFT, Mode.TRANSFER, Mode.READY, Mode.PURSUIT)


class Request(StrEnum):
    """What the operator or the flight plan asks for."""

    NONE = ""
    TRANSFER = "transfer"
    PURSUE = "pursue"
    HOLD = "hold"
    LAND = "land"
    STOP = "stop"


@dataclass(frozen=True)
class PoseSample:
    """What is known of one vehicle at a tick, however old."""

    own: Pose | None
    """The newest estimate of the vehicle itself."""
    last_contact: float
    """When its link last said anything (s)."""
    voltage: float = math.nan
    supervisor: int = Supervisor.ARMED | Supervisor.CAN_FLY
    """The firmware's word on its state."""
    captured: Pose | None = None
    """The newest of motion capture, whose velocity and body rates mean nothing; None where there is no motion capture."""


@dataclass(frozen=True)
class Event:
    """One tick."""

    time: float
    samples: tuple[PoseSample, ...]
    actions: tuple[SetPoint, ...] | None = None
    """The policy's set-points, if they came with this tick."""
    request: Request = Request.NONE
    reason: str = ""
    """Why it is requested, where nobody asked."""


@dataclass(frozen=True)
class Drone:
    """One vehicle's part of the state."""

    mode: Mode = Mode.GROUND
    since: float = 0.0  # s, when the mode began
    estimate: Pose | None = None  # now; reckoned on where no pose is fresh
    own: Track = _NOTHING_SEEN  # its own estimates
    captured: Track = _NOTHING_SEEN  # motion capture, with velocity and rates
    told: bool = True  # whether the estimator on board is to follow the newest of it
    seen: float = -math.inf  # s, when the pose that it is flown by was measured
    distrusted: str = ""  # why motion capture isn't believed any more in this flight
    stand: tuple[Vector | None, Vector | None] = (None, None)  # own and captured position before the lift
    acceleration: Vector = (0.0, 0.0, 0.0)  # m/s^2, what dead reckoning takes it to be
    anchor: Vector = (0.0, 0.0, 0.0)  # where it waits or lands
    trim: float = 0.0  # of the hover thrust
    low_since: float | None = None  # battery
    over_since: float | None = None  # upside down
    landing_since: float | None = None
    reason: str = ""  # why it left the pursuit
    sent: SetPoint = MOTORS_OFF


@dataclass(frozen=True)
class State:
    """The state machine's state."""

    drones: tuple[Drone, ...]
    starts: tuple[Vector, ...]
    limits: PoseLimits
    airframe: Airframe
    pillars: tuple[tuple[float, float, float], ...] = ()  # x, y, radius (m)
    time: float = 0.0
    dt: float = 0.0
    action_time: float = 0.0

    @property
    def flying(self) -> bool:
        """Whether any motor may be on."""
        return any(drone.mode in FLYING for drone in self.drones)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Of all vehicles."""
        return tuple(drone.mode for drone in self.drones)

    def all_in(self, *modes: Mode) -> bool:
        """Whether every vehicle is in one of these modes."""
        return all(drone.mode in modes for drone in self.drones)


def initial_state(
    starts: Sequence[Vector],
    pillars: Sequence[Vector] = (),
    airframe: Airframe | None = None,
    settings: SafetySettings | None = None,
) -> State:
    """All vehicles on the ground; they are to start at `starts` (m); pillars are x, y, radius."""
    airframe, settings = airframe or nominal_airframe(), settings or SafetySettings()
    limits = pose_limits(airframe, settings.pose_timeout)
    return State(tuple(Drone() for _ in starts), tuple(starts), limits, airframe, tuple(pillars))


def step(settings: SafetySettings, state: State, event: Event) -> tuple[State, tuple[SetPoint, ...]]:
    """The state after a tick, and the set-point of each vehicle."""
    return decide(settings, see(settings, state, event.time, event.samples), event)


# -- what is seen


def see(settings: SafetySettings, state: State, time: float, samples: Sequence[PoseSample]) -> State:
    """The state with each vehicle's estimate brought to `time` (s), by what of its poses can be believed."""
    dt = min(max(time - state.time, 0.0), 0.1)
    drones = tuple(
        _sense(settings, state.limits, drone, sample, time, dt)
        for drone, sample in zip(state.drones, samples, strict=True)
    )
    return replace(state, drones=drones, time=time, dt=dt)


def _sense(settings, limits, drone, sample, now, dt) -> Drone:
    """The drone with its estimate at `now`: the newest good pose moved on, or reckoned from the last estimate.

    Motion capture is what it is flown by, until it is lost; from then on the vehicle's own estimate is.
    """
    moving = drone.mode in FLYING and not (drone.mode is Mode.LIFT and now - drone.since < SPIN_UP)
    by_capture = sample.captured is not None and not drone.distrusted
    reckoned = None if by_capture and drone.own.fresh(now, limits) else drone.estimate
    own = follow(drone.own, sample.own, now, limits, moving, reckoned)
    captured, distrusted, source = drone.captured, drone.distrusted, own
    if by_capture:
        seen = _with_motion(sample.captured, captured.pose, sample.own)
        captured = source = follow(captured, seen, now, limits, moving, drone.estimate)
        if captured.pose is seen:
            drone = replace(drone, told=not moving or own.pose is None or follows(own.pose, seen, limits))
            if own.fresh(now, limits):
                verdict = agree(*at_one_time(seen, own.pose), limits)
                if moving and verdict:
                    captured = source = Track(drone.captured.pose, verdict)
        if moving and not captured.fresh(now, limits):
            distrusted, source = captured.verdict or "pose lost", own
    drone = replace(drone, own=own, captured=captured, distrusted=distrusted)
    if source.fresh(now, limits):
        estimate = moved_on(source.pose, max(now, source.pose.time))
        return replace(
            drone,
            estimate=estimate,
            seen=source.pose.time,
            acceleration=level_acceleration(estimate.quaternion),
        )
    if drone.estimate is None:
        return drone
    old = drone.estimate
    velocity = tuple(v + dt * a for v, a in zip(old.velocity, drone.acceleration, strict=True))
    position = tuple(p + dt * v for p, v in zip(old.position, velocity, strict=True))
    return replace(drone, estimate=old._replace(time=now, position=position, velocity=velocity))


def _with_motion(pose, last, own) -> Pose:
    """A pose of motion capture with the velocity from differences, smoothed, and the body rates of the gyroscope."""
    if last is None or pose.time <= last.time:
        return pose if last is None else last
    if (pose.position, pose.quaternion) == (last.position, last.quaternion):
        return last._replace(time=pose.time)  # which is judged frozen
    step = pose.time - last.time
    share = 1.0 - math.exp(-step / SMOOTHING)
    velocity = tuple(
        v + share * ((p - q) / step - v)
        for p, q, v in zip(pose.position, last.position, last.velocity, strict=True)
    )
    return pose._replace(velocity=velocity, body_rates=pose.body_rates if own is None else own.body_rates)


# -- what is done


def decide(settings: SafetySettings, state: State, event: Event) -> tuple[State, tuple[SetPoint, ...]]:
    """The state after a tick whose poses were seen already, and the set-point of each vehicle."""
    now, actions = event.time, event.actions
    finite = actions is not None and all(math.isfinite(x) for a in actions for x in a.numbers())
    action_time = now if finite else state.action_time
    drones = _requested(settings, state, event)
    troubles = [
        _trouble(settings, drone, sample, now) for drone, sample in zip(drones, event.samples, strict=True)
    ]
    if any(d.mode is Mode.PURSUIT for d in drones) and event.request is not Request.PURSUE:
        if now - action_time > settings.action_timeout:
            reason = "no action in time" if actions is None else "action not finite"
            troubles = [t or (Mode.HOLD, reason) for t in troubles]
    else:
        action_time = now
    drones = _react(settings, state, drones, troubles, now)
    state = replace(state, drones=tuple(drones), action_time=action_time)
    moved = tuple(
        _fly(settings, state, i, actions[i] if finite else None, sample)
        for i, sample in enumerate(event.samples)
    )
    return replace(state, drones=moved), tuple(drone.sent for drone in moved)


def _to(drone, mode, now, anchor=None, reason="") -> Drone:
    """The drone in another mode."""
    return replace(
        drone,
        mode=mode,
        since=now,
        anchor=drone.anchor if anchor is None else anchor,
        reason=reason or drone.reason,
        landing_since=(drone.landing_since or now) if mode in LANDING else None,
    )


def _requested(settings, state, event) -> list[Drone]:
    """The drones after what the operator, or the plan, asks for."""
    drones, request, now = list(state.drones), event.request, event.time
    if request is Request.STOP:
        return [_to(d, Mode.STOPPED, now, reason=event.reason or "stopped by hand") for d in drones]
    if request in (Request.LAND, Request.HOLD):
        anchors = _resting(settings, state, drones)
        mode = Mode.LAND if request is Request.LAND else Mode.HOLD
        able = (*_UNTROUBLED, Mode.HOLD) if request is Request.LAND else _UNTROUBLED
        reason = (event.reason or "asked to land") if request is Request.LAND else ""
        drones = [
            _to(d, Mode.LANDED, now, None, reason) if reason and d.mode is Mode.GROUND else d for d in drones
        ]
        return [
            _to(d, mode, now, a, reason) if d.mode in able else d
            for d, a in zip(drones, anchors, strict=True)
        ]
    if request is Request.TRANSFER:
        able = (*_DOWN, Mode.HOLD, Mode.PURSUIT, Mode.READY)
        if all(d.mode in able and not d.reason and d.estimate is not None for d in drones):
            return [
                _lift_off(settings, d, now) if d.mode in _DOWN else _to(d, Mode.TRANSFER, now, start)
                for d, start in zip(drones, state.starts, strict=True)
            ]
    if request is Request.PURSUE and all(d.mode is Mode.READY for d in drones):
        return [_to(d, Mode.PURSUIT, now) for d in drones]
    return drones


def _lift_off(settings, drone, now) -> Drone:
    """The drone at the beginning of its test lift."""
    x, y, z = drone.estimate.position
    stand = tuple(
        None if track.pose is None else track.pose.position for track in (drone.own, drone.captured)
    )
    return replace(_to(drone, Mode.LIFT, now, (x, y, z + settings.lift)), stand=stand)


def lift_fault(settings: SafetySettings, drone: Drone, now: float) -> str:
    """What speaks against a vehicle's poses in its test lift; empty while nothing does.

    Each source must rise and stay above its stand, and both by the same.
    """
    moves = [
        tuple(p - s for p, s in zip(track.pose.position, stand, strict=True))
        for track, stand in zip((drone.own, drone.captured), drone.stand, strict=True)
        if stand is not None
    ]
    if any(math.hypot(x, y) > ASIDE for x, y, _ in moves):
        return "the test lift went sideways: do the poses' axes and yaw agree with the vehicle's?"
    if len(moves) == 2 and math.dist(*moves) > ASIDE / 2:
        return "motion capture and own estimate rose differently: do axes and scale agree?"
    if now - drone.since > settings.lift_time:
        return f"not {settings.lift:g} m up after {settings.lift_time:g} s: do the poses' z and the weight agree?"
    return ""


def _trouble(settings, drone, sample, now) -> tuple[Mode, str] | None:
    """The mode that a drone must go to, and why; None if all is well."""
    if drone.mode not in FLYING:
        return None
    if sample.supervisor & (Supervisor.LOCKED | Supervisor.CRASHED):
        return Mode.STOPPED, "stopped by its firmware"
    if drone.mode is Mode.SETTLE:
        return None
    lost = _lost(settings, drone, sample, now)
    if drone.mode is Mode.LIFT:  # from there it may fall
        fault = lost or lift_fault(settings, drone, now)
        return (Mode.STOPPED, fault) if fault else None
    if drone.over_since is not None and now - drone.over_since > settings.tumble_time:
        return Mode.STOPPED, "tumbled"
    if lost:
        return Mode.LAND, lost
    if drone.mode is Mode.LAND:
        return None
    ill = drone.distrusted or _unfit(settings, drone, now)
    return (Mode.LAND, ill) if ill else None


def _lost(settings, drone, sample, now) -> str:
    """Why no pose tells where the drone is; empty if one does."""
    if now - sample.last_contact > settings.link_timeout:
        return "link gone"
    if now - drone.seen > settings.pose_timeout:
        return drone.own.verdict or "pose lost"
    return ""


def _unfit(settings, drone, now) -> str:
    """Why a drone whose pose is known mustn't fly on; empty if it may."""
    if drone.low_since is not None and now - drone.low_since > settings.battery_time:
        return "battery low"
    if drone.own.pose is not None and now - drone.own.pose.time > settings.link_timeout:
        return f"own estimate lost ({drone.own.verdict or 'silent'})"
    x, y, z = drone.estimate.position
    if math.hypot(x, y) > settings.arena_radius + settings.outside:
        return "outside the arena"
    if z > settings.arena_height + settings.outside:
        return "above the arena"
    if math.hypot(*drone.estimate.velocity) > settings.speed_limit:
        return "too fast"
    if up(drone.estimate.quaternion) < math.cos(math.radians(settings.tilt_limit)):
        return "too tilted"
    return ""


def _react(settings, state, drones, troubles, now) -> list[Drone]:
    """The drones after troubles: those in trouble as told; the others stop, wait, and land. A test lift ends at once."""
    team = any(d.reason for d in drones) or any(troubles)
    anchors = _resting(settings, state, drones) if team else [None] * len(drones)
    risen = all(d.mode is Mode.LIFT and _risen(d, now) for d in drones) and not team
    reacted = []
    for drone, trouble, anchor, start in zip(drones, troubles, anchors, state.starts, strict=True):
        if trouble is not None and trouble[0] is not drone.mode:
            drone = _to(drone, trouble[0], now, anchor, trouble[1])
        elif drone.mode is Mode.LIFT and team:
            drone = _to(drone, Mode.STOPPED, now, reason="another is in trouble")
        elif drone.mode in _UNTROUBLED and team:
            drone = _to(drone, Mode.HOLD, now, anchor, "another is in trouble")
        elif drone.mode is Mode.HOLD and drone.reason and now - drone.since > settings.hold_time:
            drone = _to(drone, Mode.LAND, now)
        elif risen:
            drone = _to(drone, Mode.TRANSFER, now, start)
        reacted.append(drone)
    return reacted


def _risen(drone, now) -> bool:
    near = abs(drone.estimate.position[2] - drone.anchor[2]) < RISEN
    return near and now - drone.since > 2.0 * SPIN_UP


def _fly(settings, state, i, action, sample) -> Drone:
    """Vehicle i after this tick, with its set-point."""
    drone, now = state.drones[i], state.time
    low = sample.voltage < settings.battery_low  # an unknown voltage is not low
    over = drone.estimate is not None and up(drone.estimate.quaternion) < 0.0
    drone = replace(
        drone,
        low_since=(drone.low_since if drone.low_since is not None else now) if low else None,
        over_since=(drone.over_since if drone.over_since is not None else now) if over else None,
        sent=MOTORS_OFF,
    )
    if drone.mode not in FLYING or drone.estimate is None:
        return drone
    if drone.mode is Mode.SETTLE and now - drone.since > SETTLING:
        return _to(drone, Mode.LANDED, now)
    if _is_low(settings, drone, now):
        drone = _to(drone, Mode.SETTLE, now)
    if drone.mode is Mode.SETTLE:
        return replace(drone, sent=_settling(state.airframe, drone))
    if drone.mode is Mode.PURSUIT and action is not None:
        return _pursue(settings, state, drone, i, action)
    wanted = _wanted(settings, state, drone, i)
    acceleration = wanted_acceleration(drone.estimate.velocity, wanted)
    attitude = drone.estimate.quaternion
    if (
        now - drone.seen > settings.pose_timeout
    ):  # by reckoning: the vehicle does what it is asked for, and is level else
        share = min(state.dt / settings.reaction, 1.0)
        lagged = tuple(a + share * (b - a) for a, b in zip(drone.acceleration, acceleration, strict=True))
        flown = accelerate(_yaw_only(attitude), acceleration, state.airframe, drone.trim, ANGLES)
        return replace(drone, acceleration=lagged, sent=flown)
    height, lifting = drone.estimate.position[2], drone.mode is Mode.LIFT
    if height > (0.02 if lifting else 0.1):
        error = min(max(wanted[2] - drone.estimate.velocity[2], -0.3), 0.3)
        trim = min(max(drone.trim + TRIM_GAIN * state.dt * error, -TRIM_LIMIT), TRIM_LIMIT)
        drone = replace(drone, trim=trim)
    if drone.mode is Mode.TRANSFER and _arrived(drone.estimate, drone.anchor):
        drone = _to(drone, Mode.READY, now)
    flown = accelerate(attitude, acceleration, state.airframe, drone.trim, ANGLES)
    return replace(drone, sent=flown)


def _is_low(settings, drone, now) -> bool:
    """Whether a landing is near the floor, or long enough on the way."""
    if drone.mode is not Mode.LAND:
        return False
    return drone.estimate.position[2] < LOW or now - drone.landing_since > settings.landing_time


def _settling(airframe, drone) -> SetPoint:
    """The last set-point of a landing."""
    return SetPoint(ANGLES, thrust=SETTLING_LIFT * (airframe.hover_thrust + drone.trim))


def _pursue(settings, state, drone, i, action) -> Drone:
    """The drone with the policy's action, or with what keeps it in the arena and off the others."""
    estimate = drone.estimate
    parting = None
    if settings.separation > 0.0:
        poses = [d.estimate if d.mode in FLYING else None for d in state.drones]
        parting = parting_velocity(settings, i, poses)
    aimed = estimate if parting is None else estimate._replace(velocity=parting)
    sent = state.drones[i].sent
    # until its motors have followed it turns on
    turned = turned_on(estimate.quaternion, estimate.body_rates, state.airframe.motor_time_constant)
    present = lift_acceleration(turned, max(sent.thrust, LEAST_THRUST) / state.airframe.hover_thrust)
    wanted = (
        fence_velocity(settings, estimate, present) or fence_velocity(settings, aimed, present) or parting
    )
    if wanted is None:
        return replace(drone, sent=within_reach(action, sent, state.airframe, state.dt))
    acceleration = wanted_acceleration(estimate.velocity, wanted)
    flown = accelerate(estimate.quaternion, acceleration, state.airframe, drone.trim, RATES)
    return replace(drone, sent=flown)


def _wanted(settings, state, drone, i) -> Vector:
    """The velocity asked for by the controller's modes."""
    position = drone.estimate.position
    if drone.mode is Mode.LAND:
        x, y, _ = wanted_velocity(position, (*drone.anchor[:2], position[2]), 0.5)
        return x, y, -(0.6 if position[2] < 0.2 else 1.0) * settings.landing_speed
    x, y, z = wanted_velocity(position, drone.anchor, settings.transfer_speed)
    if drone.mode is not Mode.TRANSFER:
        return x, y, z
    if position[2] < 0.2:  # straight up first
        x = y = 0.0
    if math.dist(position, drone.anchor) < 0.3:  # starts may be close to each other
        return x, y, z
    for j, other in enumerate(state.drones):  # around each other, to the right
        if j == i or other.estimate is None or other.mode not in FLYING:
            continue
        dx, dy = position[0] - other.estimate.position[0], position[1] - other.estimate.position[1]
        distance = math.hypot(dx, dy)
        if 1e-6 < distance < APART:
            push = (APART - distance) / distance * 2.0
            x, y = x + push * (dx + dy), y + push * (dy - dx)
    return x, y, z


def _resting(settings, state, drones):
    return resting_places(settings, state.pillars, [drone.estimate for drone in drones])


def _arrived(estimate, target) -> bool:
    return (
        math.dist(estimate.position, target) < 0.06 and math.dist(estimate.velocity, (0.0, 0.0, 0.0)) < 0.15
    )


def _yaw_only(quaternion):
    w, _, _, z = quaternion
    size = math.hypot(w, z)
    return (w / size, 0.0, 0.0, z / size) if size > 1e-6 else (1.0, 0.0, 0.0, 0.0)
