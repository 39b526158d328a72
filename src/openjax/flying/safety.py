"""Safety of a flight as a pure state machine: what was seen in, set-points out.

`step(settings, state, event)` decides for every vehicle, at every tick, who flies it: the policy, or the controller
that waits, lands, or lands blindly. It reads no clock and touches no link, so that a thousand faults can be flown in
simulated time.

A vehicle in trouble lands; all others stop where they are, wait a moment, and land too. Troubles: its pose is lost, its
link is silent, its battery low, it is too fast, too tilted, or outside the arena; no action came in time; a key.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from openjax.flying.controller import (
    GRAVITY,
    Airframe,
    Pose,
    Vector,
    accelerate,
    moved_on,
    up,
    wanted_acceleration,
    wanted_velocity,
)
from openjax.flying.limits import APART, SafetySettings, fence_velocity, resting_places
from openjax.flying.set_point import ANGLES, RATES, SetPoint

ATTITUDE_LAG = 0.12
"""How long the acceleration takes to follow what is asked for (s), in dead reckoning."""
BLIND_SINK = 0.4
"""A blind landing asks for this much less upward acceleration (m/s^2), so that it surely goes down."""
BLIND_SPEED = 0.6
"""It sinks faster than a landing with poses (m/s): what it doesn't know grows with the square of the time."""
BLIND_DEPTH = 0.15
"""A blind landing stops the motors this far below the floor by its reckoning (m)."""
DRIFT = 0.25
"""What dead reckoning may be wrong by after a second without poses (m): so far from it is a pose believed that returns."""
TRIM_GAIN, TRIM_LIMIT = 0.25, 0.15


class Mode(StrEnum):
    GROUND = "ground"
    TRANSFER = "transfer"  # take-off, and the way to where it is to start
    READY = "ready"
    PURSUIT = "pursuit"
    HOLD = "hold"
    LAND = "land"
    BLIND = "blind landing"
    LANDED = "landed"
    STOPPED = "stopped"


FLYING = (Mode.TRANSFER, Mode.READY, Mode.PURSUIT, Mode.HOLD, Mode.LAND, Mode.BLIND)
_UNTROUBLED = (Mode.TRANSFER, Mode.READY, Mode.PURSUIT)


class Request(StrEnum):
    """What the operator or the flight plan asks for."""

    NONE = ""
    TRANSFER = "transfer"
    PURSUE = "pursue"
    HOLD = "hold"
    LAND = "land"
    STOP = "stop"


@dataclass(frozen=True)
class Sighting:
    """What is known of one vehicle at a tick."""

    pose: Pose | None
    """The newest, however old."""
    heard: float
    """When its link last said anything (s)."""
    voltage: float = math.nan


@dataclass(frozen=True)
class Event:
    """One tick."""

    time: float
    sightings: tuple[Sighting, ...]
    actions: tuple[SetPoint, ...] | None = None
    """The policy's set-points, if they came with this tick."""
    request: Request = Request.NONE


@dataclass(frozen=True)
class Drone:
    """One vehicle's part of the state."""

    mode: Mode = Mode.GROUND
    since: float = 0.0  # s, when the mode began
    estimate: Pose | None = None  # now; reckoned on where no pose is fresh
    seen: float = -math.inf  # s, when the last pose that was believed was measured
    acceleration: Vector = (0.0, 0.0, 0.0)  # m/s^2, what dead reckoning takes it to be
    anchor: Vector = (0.0, 0.0, 0.0)  # where it waits or lands
    trim: float = 0.0  # of the hover thrust
    low_since: float | None = None  # battery
    reason: str = ""  # why it left the pursuit
    fenced: bool = False  # the last set-point kept it in the arena instead of doing what the policy wanted


@dataclass(frozen=True)
class State:
    """The state machine's state."""

    drones: tuple[Drone, ...]
    starts: tuple[Vector, ...]
    pillars: tuple[tuple[float, float, float], ...] = ()  # x, y, radius (m)
    airframe: Airframe = field(default_factory=Airframe)
    time: float = 0.0
    action_time: float = 0.0

    @property
    def flying(self) -> bool:
        """Whether any motor may be on."""
        return any(drone.mode in FLYING for drone in self.drones)

    @property
    def modes(self) -> tuple[Mode, ...]:
        return tuple(drone.mode for drone in self.drones)

    def all_in(self, *modes: Mode) -> bool:
        return all(drone.mode in modes for drone in self.drones)


def initial_state(
    starts: Sequence[Vector], pillars: Sequence[Vector] = (), airframe: Airframe | None = None
) -> State:
    """All vehicles on the ground; they are to start at `starts` (m); pillars are x, y, radius."""
    return State(tuple(Drone() for _ in starts), tuple(starts), tuple(pillars), airframe or Airframe())


def step(settings: SafetySettings, state: State, event: Event) -> tuple[State, tuple[SetPoint, ...]]:
    """The state after a tick, and the set-point of each vehicle."""
    dt = min(max(event.time - state.time, 0.0), 0.1)
    drones = [
        _sense(settings, drone, sighting, event.time, dt)
        for drone, sighting in zip(state.drones, event.sightings, strict=True)
    ]
    action_time = event.time if event.actions is not None else state.action_time
    drones = _requested(settings, state, drones, event)
    troubles = [
        _trouble(settings, drone, sighting, event.time)
        for drone, sighting in zip(drones, event.sightings, strict=True)
    ]
    if any(d.mode is Mode.PURSUIT for d in drones) and event.request is not Request.PURSUE:
        if event.time - action_time > settings.action_timeout:
            troubles = [t or (Mode.HOLD, "no action in time") for t in troubles]
    else:
        action_time = event.time
    drones = _react(settings, state, drones, troubles, event.time)
    moved = [_fly(settings, state, drone, i, event, dt) for i, drone in enumerate(drones)]
    drones = tuple(drone for drone, _ in moved)
    return replace(state, drones=drones, time=event.time, action_time=action_time), tuple(
        set_point for _, set_point in moved
    )


def usable(pose: Pose | None) -> bool:
    """Whether a pose is one: finite numbers and an attitude."""
    if pose is None:
        return False
    numbers = (*pose.position, *pose.velocity, *pose.quaternion)
    return all(map(math.isfinite, numbers)) and abs(sum(q * q for q in pose.quaternion) - 1.0) < 0.1


def _sense(settings, drone, sighting, now, dt):
    """The drone with its estimate brought to `now`: the newest pose moved on, or reckoned from the last estimate."""
    pose = sighting.pose
    if usable(pose) and now - pose.time <= settings.pose_timeout and _believable(settings, drone, pose):
        estimate = moved_on(pose, max(now, pose.time))
        w, x, y, z = estimate.quaternion
        lift = max(up(estimate.quaternion), 0.3)
        tilt = (2 * (x * z + w * y) / lift * GRAVITY, 2 * (y * z - w * x) / lift * GRAVITY, 0.0)
        return replace(drone, estimate=estimate, seen=pose.time, acceleration=tilt)
    if drone.estimate is None:
        return drone
    old = drone.estimate
    velocity = tuple(v + dt * a for v, a in zip(old.velocity, drone.acceleration, strict=True))
    position = tuple(p + dt * v for p, v in zip(old.position, velocity, strict=True))
    return replace(drone, estimate=old._replace(time=now, position=position, velocity=velocity))


def _believable(settings, drone, pose) -> bool:
    """Whether a flying vehicle can have got to where a pose says it is: motion capture takes one for another at times."""
    if drone.mode not in FLYING or drone.estimate is None:
        return True
    room = settings.pose_jump + DRIFT * max(pose.time - drone.seen, 0.0)
    return math.dist(pose.position, moved_on(drone.estimate, pose.time).position) <= room


def _requested(settings, state, drones, event):
    """The drones after what the operator asks for."""

    def to(drone, mode, anchor=None, reason=""):
        anchor = drone.anchor if anchor is None else anchor
        return replace(drone, mode=mode, since=event.time, anchor=anchor, reason=reason or drone.reason)

    request = event.request
    if request is Request.STOP:
        return [to(d, Mode.STOPPED, reason="stopped by hand") for d in drones]
    if request is Request.LAND:
        anchors = _resting(settings, state, drones)
        return [
            to(d, Mode.LAND, a, "asked to land") if d.mode in (*_UNTROUBLED, Mode.HOLD) else d
            for d, a in zip(drones, anchors, strict=True)
        ]
    if request is Request.HOLD:
        anchors = _resting(settings, state, drones)
        return [
            to(d, Mode.HOLD, a) if d.mode in _UNTROUBLED else d for d, a in zip(drones, anchors, strict=True)
        ]
    if request is Request.TRANSFER:
        able = (Mode.GROUND, Mode.LANDED, Mode.HOLD, Mode.PURSUIT, Mode.READY)
        if all(d.mode in able and not d.reason and d.estimate is not None for d in drones):
            return [to(d, Mode.TRANSFER, s) for d, s in zip(drones, state.starts, strict=True)]
    if request is Request.PURSUE and all(d.mode is Mode.READY for d in drones):
        return [to(d, Mode.PURSUIT) for d in drones]
    return drones


def _trouble(settings, drone, sighting, now) -> tuple[Mode, str] | None:
    """The mode that a drone must go to, and why; None if all is well."""
    if drone.mode not in FLYING:
        return None
    silent = now - sighting.heard > settings.link_timeout
    lost = now - drone.seen > settings.pose_timeout
    if drone.mode is Mode.BLIND:
        return None if silent or lost else (Mode.LAND, drone.reason)
    if silent:
        return Mode.BLIND, "link gone"
    if lost:
        jumped = usable(sighting.pose) and now - sighting.pose.time <= settings.pose_timeout
        return Mode.BLIND, "pose jumped" if jumped else "pose lost"
    if drone.mode is Mode.LAND:
        return None
    if drone.low_since is not None and now - drone.low_since > settings.battery_time:
        return Mode.LAND, "battery low"
    x, y, z = drone.estimate.position
    if math.hypot(x, y) > settings.arena_radius + settings.outside:
        return Mode.LAND, "outside the arena"
    if z > settings.arena_height + settings.outside:
        return Mode.LAND, "above the arena"
    if math.dist(drone.estimate.velocity, (0.0, 0.0, 0.0)) > settings.speed_limit:
        return Mode.LAND, "too fast"
    if up(drone.estimate.quaternion) < math.cos(math.radians(settings.tilt_limit)):
        return Mode.LAND, "too tilted"
    return None


def _react(settings, state, drones, troubles, now):
    """The drones after troubles: those in trouble as told; the others stop, wait, and land."""
    anchors = None
    if any(troubles):
        anchors = _resting(settings, state, drones)
    team = any(d.reason for d in drones) or any(troubles)
    reacted = []
    for i, (drone, trouble) in enumerate(zip(drones, troubles, strict=True)):
        if trouble is not None and trouble[0] is not drone.mode:
            mode, reason = trouble
            keep = drone.mode is Mode.LAND  # a landing that goes blind stays where it lands
            anchor = drone.anchor if keep else anchors[i]
            drone = replace(drone, mode=mode, since=now, anchor=anchor, reason=reason)
        elif drone.mode in _UNTROUBLED and team:
            anchor = (anchors or _resting(settings, state, drones))[i]
            drone = replace(drone, mode=Mode.HOLD, since=now, anchor=anchor, reason="another is in trouble")
        elif drone.mode is Mode.HOLD and drone.reason and now - drone.since > settings.hold_time:
            drone = replace(drone, mode=Mode.LAND, since=now)
        reacted.append(drone)
    return reacted


def _fly(settings, state, drone, i, event, dt) -> tuple[Drone, SetPoint]:
    """The drone after this tick, and its set-point."""
    sighting = event.sightings[i]
    low = sighting.voltage < settings.battery_low  # an unknown voltage is not low
    since = (drone.low_since if drone.low_since is not None else event.time) if low else None
    drone = replace(drone, low_since=since, fenced=False)
    if drone.mode not in FLYING or drone.estimate is None:
        return drone, SetPoint()
    estimate = drone.estimate
    height = estimate.position[2]
    if drone.mode is Mode.PURSUIT and event.actions is not None:
        fence = fence_velocity(settings, estimate)
        if fence is None:
            return drone, event.actions[i]
        acceleration = wanted_acceleration(estimate.velocity, fence)
        return replace(drone, fenced=True), accelerate(
            estimate.quaternion, acceleration, state.airframe, drone.trim, RATES
        )
    if drone.mode is Mode.LAND and height < 0.05:
        return replace(drone, mode=Mode.LANDED, since=event.time), SetPoint()
    if drone.mode is Mode.BLIND and height < -BLIND_DEPTH:
        return replace(drone, mode=Mode.LANDED, since=event.time), SetPoint()
    wanted = _wanted(settings, state, drone, i)
    acceleration = wanted_acceleration(estimate.velocity, wanted)
    if drone.mode is Mode.BLIND:
        share = min(dt / ATTITUDE_LAG, 1.0)
        lagged = tuple(a + share * (b - a) for a, b in zip(drone.acceleration, acceleration, strict=True))
        drone = replace(drone, acceleration=lagged)
        # the attitude is not known any more: level but for what is asked for on board
        x, y, z = acceleration
        yaw_only = _yaw_only(estimate.quaternion)
        return drone, accelerate(yaw_only, (x, y, z - BLIND_SINK), state.airframe, drone.trim, ANGLES)
    if height > 0.1:
        error = min(max(wanted[2] - estimate.velocity[2], -0.3), 0.3)
        trim = min(max(drone.trim + TRIM_GAIN * dt * error, -TRIM_LIMIT), TRIM_LIMIT)
        drone = replace(drone, trim=trim)
    if drone.mode is Mode.TRANSFER and _arrived(estimate, drone.anchor):
        drone = replace(drone, mode=Mode.READY, since=event.time)
    return drone, accelerate(estimate.quaternion, acceleration, state.airframe, drone.trim, ANGLES)


def _wanted(settings, state, drone, i) -> Vector:
    """The velocity asked for by the controller's modes."""
    position = drone.estimate.position
    if drone.mode in (Mode.LAND, Mode.BLIND):
        x, y, _ = wanted_velocity(position, (*drone.anchor[:2], position[2]), 0.5)
        if drone.mode is Mode.BLIND:
            return x, y, -BLIND_SPEED
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
