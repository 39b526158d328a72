"""Safety of a flight as a pure state machine: what was seen in, set-points out.

`see` (`openjax.flying.estimation`) judges the poses and brings each vehicle's estimate to now;
`decide` says who flies each vehicle: the policy, or the controller that lifts, waits and lands, at
need by reckoning (`openjax.flying.steering`). `step` is both. Nothing here reads a clock or touches
a link, so that thousands of faults can be flown in simulated time.

A vehicle in trouble lands; all others stop where they are, wait a moment, and land too. Troubles:
its pose is lost, its link is silent, its battery low, it is too fast, too tilted, or outside the
arena; no action came in time; a key.
"""

import math

from openjax.flying.controller import up
from openjax.flying.crtp import Supervisor
from openjax.flying.estimation import see
from openjax.flying.set_point import SetPoint
from openjax.flying.state import FLYING, SPIN_UP, Drone, Event, Mode, Request, State
from openjax.flying.steering import steer

ASIDE = 0.08
"""How far (m) a vehicle may move sideways in the test lift: a hover that starts beside its trim."""
RISEN = 0.04
"""The test lift is over this close (m) to its height."""
_DOWN = (Mode.GROUND, Mode.LANDED)
_UNTROUBLED = (Mode.LIFT, Mode.TRANSFER, Mode.READY, Mode.PURSUIT)


def step(state: State, event: Event) -> tuple[State, tuple[SetPoint, ...]]:
    """The state after a tick, and the set-point of each vehicle."""
    return decide(see(state, event.time, event.samples), event)


def decide(state: State, event: Event) -> tuple[State, tuple[SetPoint, ...]]:
    """The state after a tick whose poses were seen already, and the set-point of each vehicle."""
    now = event.time
    actions = event.actions
    finite = actions is not None and all(math.isfinite(x) for action in actions for x in action)
    action_time = now if finite else state.action_time
    drones = _requested(state, event)
    troubles = [_trouble(state, *of) for of in zip(drones, event.samples, strict=True)]
    if any(d.mode is Mode.PURSUIT for d in drones) and event.request is not Request.PURSUE:
        if now - action_time > state.settings.action_timeout:
            reason = "no action in time" if actions is None else "action not finite"
            troubles = [t or (Mode.HOLD, reason) for t in troubles]
    else:
        action_time = now
    state = state._replace(drones=_react(state, drones, troubles), action_time=action_time)
    moved = tuple(
        steer(state, i, actions[i] if finite else None, sample)
        for i, sample in enumerate(event.samples)
    )
    return state._replace(drones=moved), tuple(drone.sent for drone in moved)


def _requested(state, event) -> tuple[Drone, ...]:
    """The drones after what the operator, or the plan, asks for."""
    drones = state.drones
    now = event.time
    anchors = state.starts
    if event.request is Request.STOP:
        return tuple(
            d.to(Mode.STOPPED, now, reason=event.reason or "stopped by hand") for d in drones
        )
    if event.request is Request.PURSUE and state.all_in(Mode.READY):
        return tuple(d.to(Mode.PURSUIT, now) for d in drones)
    answer = {Request.LAND: _land, Request.HOLD: _hold}.get(event.request)
    if answer is not None:
        anchors = state.resting_places()
    elif event.request is Request.TRANSFER:
        able = (*_DOWN, Mode.HOLD, Mode.PURSUIT, Mode.READY)
        if all(d.mode in able and not d.reason and d.estimate is not None for d in drones):
            answer = _transfer
    if answer is None:
        return drones
    return tuple(answer(state, event, d, a) for d, a in zip(drones, anchors, strict=True))


def _land(state, event, drone, anchor) -> Drone:
    reason = event.reason or "asked to land"
    if drone.mode is Mode.GROUND:
        return drone.to(Mode.LANDED, event.time, reason=reason)
    return (
        drone.to(Mode.LAND, event.time, anchor, reason)
        if drone.mode in (*_UNTROUBLED, Mode.HOLD)
        else drone
    )


def _hold(state, event, drone, anchor) -> Drone:
    return drone.to(Mode.HOLD, event.time, anchor) if drone.mode in _UNTROUBLED else drone


def _transfer(state, event, drone, start) -> Drone:
    """On the way to its start; at the beginning of its test lift if it stands."""
    if drone.mode not in _DOWN:
        return drone.to(Mode.TRANSFER, event.time, start)
    x, y, z = drone.estimate.position
    stand = tuple(None if t.pose is None else t.pose.position for t in (drone.own, drone.captured))
    return drone.to(Mode.LIFT, event.time, (x, y, z + state.settings.lift))._replace(stand=stand)


def lift_fault(state: State, drone: Drone) -> str:
    """What speaks against a vehicle's poses in its test lift; empty while nothing does.

    Each source must rise, stay above its stand, and not rise past where a fall still does no harm;
    both by the same.
    """
    settings = state.settings
    moves = [
        tuple(p - s for p, s in zip(track.pose.position, stand, strict=True))
        for track, stand in zip((drone.own, drone.captured), drone.stand, strict=True)
        if stand is not None
    ]
    if any(z > 2.0 * settings.lift for *_, z in moves):
        return "the test lift went too high: is it lighter, or another, than --vehicle says?"
    if any(math.hypot(x, y) > ASIDE for x, y, _ in moves):
        return "the test lift went sideways: do the poses' axes and yaw agree with the vehicle's?"
    if len(moves) == 2 and math.dist(*moves) > ASIDE / 2:
        return "motion capture and own estimate rose differently: do axes and scale agree?"
    if state.time - drone.since > settings.lift_time:
        return f"not {settings.lift:g} m up after {settings.lift_time:g} s: do the poses' z and the weight agree?"
    return ""


def _trouble(state, drone, sample) -> tuple[Mode, str] | None:
    """The mode that a drone must go to, and why; None if all is well."""
    if drone.mode not in FLYING:
        return None
    if sample.supervisor & (Supervisor.LOCKED | Supervisor.CRASHED):
        return Mode.STOPPED, "stopped by its firmware"
    if drone.mode is Mode.SETTLE:
        return None
    lost = _lost(state, drone, sample)
    if drone.mode is Mode.LIFT:  # from there it may fall
        fault = lost or lift_fault(state, drone)
        return (Mode.STOPPED, fault) if fault else None
    if drone.over_since is not None and state.time - drone.over_since > state.settings.tumble_time:
        return Mode.STOPPED, "tumbled"
    ill = lost or (drone.mode is not Mode.LAND and (drone.distrusted or _unfit(state, drone)))
    return (Mode.LAND, ill) if ill else None


def _lost(state, drone, sample) -> str:
    """Why no pose tells where the drone is; empty if one does."""
    if state.time - sample.last_contact > state.settings.link_timeout:
        return "link gone"
    if state.time - drone.seen > state.settings.pose_timeout:
        return drone.own.verdict or "pose lost"
    return ""


def _unfit(state, drone) -> str:
    """Why a drone whose pose is known mustn't fly on; empty if it may."""
    settings = state.settings
    now = state.time
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


def _react(state, drones, troubles) -> tuple[Drone, ...]:
    """The drones after troubles: those in trouble as told; the others stop, wait, and land. A test
    lift ends at once.
    """
    now = state.time
    team = any(d.reason for d in drones) or any(troubles)
    anchors = state.resting_places() if team else [None] * len(drones)
    risen = all(d.mode is Mode.LIFT and _risen(d, now) for d in drones) and not team
    reacted = []
    for drone, trouble, anchor, start in zip(drones, troubles, anchors, state.starts, strict=True):
        if trouble is not None and trouble[0] is not drone.mode:
            drone = drone.to(trouble[0], now, anchor, trouble[1])
        elif drone.mode is Mode.LIFT and team:
            drone = drone.to(Mode.STOPPED, now, reason="another is in trouble")
        elif team and not drone.reason and drone.mode in (*_UNTROUBLED, Mode.HOLD):
            drone = drone.to(Mode.HOLD, now, anchor, "another is in trouble")
        elif (
            drone.mode is Mode.HOLD
            and drone.reason
            and now - drone.since > state.settings.hold_time
        ):
            drone = drone.to(Mode.LAND, now)
        elif risen:
            drone = drone.to(Mode.TRANSFER, now, start)
        reacted.append(drone)
    return tuple(reacted)


def _risen(drone, now) -> bool:
    near = abs(drone.estimate.position[2] - drone.anchor[2]) < RISEN
    return near and now - drone.since > 2.0 * SPIN_UP
