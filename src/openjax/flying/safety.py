"""Safety of a flight as a pure state machine: what was seen in, set-points out.

Decided is who flies each vehicle, the policy or the controller that lifts, waits and
lands. How it is flown in each mode is `openjax.flying.steering`'s; what is possible,
where a vehicle could still stop and what it can follow, is `openjax.flying.limits`'.

`see` (`openjax.flying.estimation`) judges the poses and brings each vehicle's estimate
to now; `decide` does the rest; `step` is both. Nothing here reads a clock or touches a
link, so that thousands of faults can be flown in simulated time.

A vehicle in trouble lands; all others stop where they are, wait a moment, and land too.
Troubles: its pose is lost, its link is silent, its battery low, it is too fast, too
tilted, or outside the arena; no action came in time; a key.
"""

import math

from openjax.flying.controller import Vector, up
from openjax.flying.crtp import Supervisor
from openjax.flying.estimation import see
from openjax.flying.limits import resting_places
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
    time = event.time
    actions = event.actions
    finite = actions is not None and all(math.isfinite(x) for action in actions for x in action)
    action_time = time if finite else state.action_time
    # requests first, so that troubles have the last word
    drones = _request(state, event)
    both = zip(drones, event.samples, strict=True)
    troubles = [_trouble(state, drone, sample) for drone, sample in both]
    pursuing = any(d.mode is Mode.PURSUIT for d in drones)
    if pursuing and event.request is not Request.PURSUE:
        if time - action_time > state.settings.action_timeout:
            reason = "no action in time" if actions is None else "action not finite"
            troubles = [t or (Mode.HOLD, reason) for t in troubles]
    else:
        # the clock of the actions starts with the game
        action_time = time
    reactions = zip(_react(state, drones, troubles), event.samples, strict=True)
    drones = tuple(_watch(state, drone, sample) for drone, sample in reactions)
    state = state._replace(drones=drones, action_time=action_time)
    next_drones = tuple(steer(state, i, actions[i] if finite else None) for i in range(len(drones)))
    return state._replace(drones=next_drones), tuple(drone.sent for drone in next_drones)


def _request(state, event) -> tuple[Drone, ...]:
    """The drones after what the operator, or the plan, asks for."""
    drones = state.drones
    time = event.time
    anchors = state.starts
    if event.request is Request.STOP:
        reason = event.reason or "stopped by hand"
        return tuple(d.to(Mode.STOPPED, time, reason=reason) for d in drones)
    if event.request is Request.PURSUE and state.all_in(Mode.READY):
        return tuple(d.to(Mode.PURSUIT, time) for d in drones)
    answer = {Request.LAND: _land, Request.HOLD: _hold}.get(event.request)
    if answer is not None:
        anchors = resting_places_of(state)
    elif event.request is Request.TRANSFER:
        # who was in trouble, or landed for some reason, never rises again in this flight
        able = (*_DOWN, Mode.HOLD, Mode.PURSUIT, Mode.READY)
        if all(d.mode in able and not d.reason and d.estimate is not None for d in drones):
            answer = _transfer
    if answer is None:
        return drones
    return tuple(answer(state, event, d, a) for d, a in zip(drones, anchors, strict=True))


def _land(state, event, drone, anchor) -> Drone:
    """The drone on its way down to its anchor; one that lands already, or may not fly,
    stays as it is.
    """
    reason = event.reason or "asked to land"
    if drone.mode is Mode.GROUND:
        return drone.to(Mode.LANDED, event.time, reason=reason)
    if drone.mode in (*_UNTROUBLED, Mode.HOLD):
        return drone.to(Mode.LAND, event.time, anchor, reason)
    return drone


def _hold(state, event, drone, anchor) -> Drone:
    """The drone waiting at its anchor, if it flies and isn't in trouble."""
    return drone.to(Mode.HOLD, event.time, anchor) if drone.mode in _UNTROUBLED else drone


def _transfer(state, event, drone, start) -> Drone:
    """On the way to its start; at the beginning of its test lift if it stands."""
    if drone.mode not in _DOWN:
        return drone.to(Mode.TRANSFER, event.time, start)
    x, y, z = drone.estimate.position
    tracks = (drone.own, drone.captured)
    stand = tuple(None if track.pose is None else track.pose.position for track in tracks)
    return drone.to(Mode.LIFT, event.time, (x, y, z + state.settings.lift))._replace(stand=stand)


def lift_fault(state: State, drone: Drone) -> str:
    """The fault of a vehicle's poses in its test lift; empty if there is none.

    Each source must rise, stay above its stand, and not rise past where a fall still
    does no harm; both by the same.
    """
    settings = state.settings
    moves = []
    for track, stand in zip((drone.own, drone.captured), drone.stand, strict=True):
        if stand is not None:
            offsets = zip(track.pose.position, stand, strict=True)
            moves.append(tuple(p - s for p, s in offsets))
    if any(z > 2.0 * settings.lift for *_, z in moves):
        return "the test lift went too high: is it lighter, or another, than --vehicle says?"
    if any(math.hypot(x, y) > ASIDE for x, y, _ in moves):
        return "the test lift went sideways: do the poses' axes and yaw agree with the vehicle's?"
    if len(moves) == 2 and math.dist(moves[0], moves[1]) > ASIDE / 2:
        return "motion capture and own estimate rose differently: do axes and scale agree?"
    if state.time - drone.since > settings.lift_time:
        return (
            f"not {settings.lift:g} m up after {settings.lift_time:g} s: do the poses' z and the "
            "weight agree?"
        )
    return ""


def _trouble(state, drone, sample) -> tuple[Mode, str] | None:
    """The mode that a drone must go to, and why; None if all is well."""
    if drone.mode not in FLYING:
        return None
    # the firmware has stopped its motors: whatever is asked of it, it won't fly
    if sample.supervisor & (Supervisor.LOCKED | Supervisor.CRASHED):
        return Mode.STOPPED, "stopped by its firmware"
    if drone.mode is Mode.SETTLE:
        return None
    loss = _loss(state, drone, sample)
    if drone.mode is Mode.LIFT:  # from there it may fall
        fault = loss or lift_fault(state, drone)
        return (Mode.STOPPED, fault) if fault else None
    if drone.over_since is not None and state.time - drone.over_since > state.settings.tumble_time:
        return Mode.STOPPED, "tumbled"
    # who lands already goes on landing, whatever else is wrong with it
    fault = loss
    if not loss and drone.mode is not Mode.LAND:
        fault = drone.captured.fault or _unfit(state, drone)
    return (Mode.LAND, fault) if fault else None


def _loss(state, drone, sample) -> str:
    """The reason that no pose tells where the drone is; empty if one does."""
    if state.time - sample.last_contact > state.settings.link_timeout:
        return "link gone"
    if state.time - drone.seen > state.settings.pose_timeout:
        return drone.own.verdict or "pose lost"
    return ""


def _unfit(state, drone) -> str:
    """The reason that a drone whose pose is known mustn't fly on; empty if it may."""
    settings = state.settings
    time = state.time
    if drone.low_since is not None and time - drone.low_since > settings.battery_time:
        return "battery low"
    if drone.alone_since is not None and time - drone.alone_since > settings.alone_time:
        return f"{settings.alone_time:g} s by its own estimate alone"
    if drone.own.pose is not None and time - drone.own.pose.time > settings.link_timeout:
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
    """The drones after troubles: those in trouble as told; the others stop, wait, and
    land. A test lift ends at once.
    """
    time = state.time
    team = any(d.reason for d in drones) or any(troubles)
    anchors = resting_places_of(state) if team else [None] * len(drones)
    all_up = all(d.mode is Mode.LIFT and _has_lifted(d, time) for d in drones) and not team
    reactions = []
    for drone, trouble, anchor, start in zip(drones, troubles, anchors, state.starts, strict=True):
        waits = time - drone.since > state.settings.hold_time
        if trouble is not None and trouble[0] is not drone.mode:
            mode, reason = trouble
            drone = drone.to(mode, time, anchor, reason)
        elif drone.mode is Mode.LIFT and team:
            drone = drone.to(Mode.STOPPED, time, reason="another is in trouble")
        elif team and not drone.reason and drone.mode in (*_UNTROUBLED, Mode.HOLD):
            drone = drone.to(Mode.HOLD, time, anchor, "another is in trouble")
        elif drone.mode is Mode.HOLD and drone.reason and waits:
            drone = drone.to(Mode.LAND, time)
        elif all_up:
            drone = drone.to(Mode.TRANSFER, time, start)
        reactions.append(drone)
    return tuple(reactions)


def _has_lifted(drone, time) -> bool:
    """True once a test lift is over; not before its rotors must have turned up."""
    is_near = abs(drone.estimate.position[2] - drone.anchor[2]) < RISEN
    return is_near and time - drone.since > 2.0 * SPIN_UP


def _watch(state, drone, sample) -> Drone:
    """The drone with since when its battery is low and since when it is upside down."""

    def since(begin, is_so):
        return (state.time if begin is None else begin) if is_so else None

    low = sample.voltage < state.settings.battery_low  # an unknown voltage is not low
    over = drone.estimate is not None and up(drone.estimate.quaternion) < 0.0
    is_confirmed = drone.captured.pose is not None and not drone.captured.fault
    is_alone = drone.mode in FLYING and not is_confirmed
    return drone._replace(
        alone_since=since(drone.alone_since, is_alone),
        low_since=since(drone.low_since, low),
        over_since=since(drone.over_since, over),
    )


def resting_places_of(state: State) -> list[Vector]:
    """Places where the vehicles of a flight may wait or land (m)."""
    poses = [drone.estimate for drone in state.drones]
    return resting_places(state.settings, state.pillars, poses)
