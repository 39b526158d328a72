"""The estimate of each vehicle, brought to the present by those of its poses that
can be believed.
"""

from collections.abc import Sequence

from openjax.flying.controller import level_acceleration, moved_on
from openjax.flying.drift import drifting
from openjax.flying.judge import Verdict, offset_of
from openjax.flying.sources import VehicleTick, with_motion
from openjax.flying.state import FLYING, SPIN_UP, Drone, Mode, PoseSample, State

AIRBORNE = (Mode.TRANSFER, Mode.READY, Mode.PURSUIT, Mode.HOLD, Mode.LAND)
"""Modes in which nothing but air carries a vehicle."""


def see(state: State, time: float, samples: Sequence[PoseSample]) -> State:
    """The state with each vehicle's estimate at `time` (s): the newest good pose moved
    on, or reckoned from the last one.

    Motion capture is what a vehicle is flown by, until it is lost; from then on its own
    estimate is.
    """
    # a loop that stood still mustn't be reckoned over in one step
    state = state._replace(time=time, dt=min(max(time - state.time, 0.0), 0.1))
    both = zip(state.drones, samples, strict=True)
    drones = tuple(_estimate(state, drone, sample) for drone, sample in both)
    drift = drifting([drone.own.innovations.drift for drone in drones])
    return state._replace(
        drones=tuple(
            _without_drift(state, drone) if drifts and sample.captured is None else drone
            for drone, drifts, sample in zip(drones, drift, samples, strict=True)
        )
    )


def _without_drift(state, drone) -> Drone:
    """The drone whose own estimate drifts: none is believed any more in this flight,
    and it is where the last one was, as fast as thrust and drag explain.
    """
    estimates = drone.own
    if estimates.fault or drone.mode not in AIRBORNE:
        return drone
    pose = estimates.innovations.pose
    excess = (*estimates.innovations.drift.totals, 0.0)
    velocity = tuple(v - part for v, part in zip(pose.velocity, excess, strict=True))
    return drone._replace(
        own=estimates._replace(verdict=Verdict.DRIFTS, fault=Verdict.DRIFTS),
        estimate=moved_on(pose._replace(velocity=velocity), state.time),
    )


def _estimate(state, drone, sample) -> Drone:
    """The drone with its estimate now, after what was newly told of it."""
    time = state.time
    spins_up = drone.mode is Mode.LIFT and time - drone.since < SPIN_UP
    tick = VehicleTick(
        time,
        state.limits,
        state.airframe,
        command=drone.sent,
        moving=drone.mode in FLYING and not spins_up,
        airborne=drone.mode in AIRBORNE,
    )
    has_capture = sample.captured is not None
    if not drone.own.fault:
        drone = _with_own(drone, sample, tick, has_capture and not drone.captured.fault)
    if has_capture and not drone.captured.fault:
        drone = _with_capture(drone, sample, tick)
    source = drone.captured if has_capture and not drone.captured.fault else drone.own
    if source.fresh(tick) and not source.fault:
        estimate = moved_on(source.pose, max(time, source.pose.time))
        level = level_acceleration(estimate.quaternion)
        return drone._replace(estimate=estimate, seen=source.pose.time, acceleration=level)
    return drone if drone.estimate is None else _reckon(state, drone)


def _reckon(state, drone) -> Drone:
    """The drone a tick on by dead reckoning, its attitude as it was."""
    # without a pose nothing tells how it turns
    old = drone.estimate
    dt = state.dt
    velocity = tuple(v + dt * a for v, a in zip(old.velocity, drone.acceleration, strict=True))
    position = tuple(p + dt * v for p, v in zip(old.position, velocity, strict=True))
    estimate = old._replace(time=state.time, position=position, velocity=velocity)
    return drone._replace(estimate=estimate)


def _with_own(drone, sample, tick, by_capture) -> Drone:
    """The drone after its newest own estimate. `by_capture`: whether it is flown by motion
    capture, which must confirm its own where that was lost or wrong.
    """
    estimates = drone.own
    capture = drone.captured
    limits = tick.limits
    is_led = by_capture and estimates.fresh(tick)
    # what it is flown by is motion capture: that says nothing of where its own leads
    newer = estimates.update(sample.own, tick, None if is_led else drone.estimate)
    is_new = newer.pose is not estimates.pose
    to_confirm = is_new and by_capture and not is_led and tick.moving and capture.fresh(tick)
    if to_confirm and not offset_of(capture.pose, newer.pose).is_agreement(limits):
        newer = newer._replace(pose=estimates.pose, verdict=Verdict.JUMPED)
        is_new = False
    next_own = estimates.check_motion(newer, tick, sample.force)
    if not is_new:
        # what told nothing but wrong poses until it was lost may tell believable ones,
        # of another place, once anything can have happened
        is_lost = tick.airborne and not (estimates.fresh(tick) or capture.fresh(tick))
        return drone._replace(own=next_own._replace(fault=next_own.verdict if is_lost else ""))
    drone = drone._replace(own=next_own)
    # where motion capture tells otherwise than the estimate, it isn't what that followed
    if not next_own.fault or (
        capture.pose is not None and not offset_of(capture.pose, newer.pose).is_error(limits)
    ):
        return drone
    # what the estimator on board follows can't confirm it: neither is believed any more,
    # back to where the sums say that the vehicle is
    estimate = moved_on(next_own.innovations.corrected_pose(), tick.time)
    return drone._replace(estimate=estimate, captured=capture._replace(fault=next_own.fault))


def _with_capture(drone, sample, tick) -> Drone:
    """The drone after the newest of motion capture: whether it is believed, and told to
    the estimator on board.
    """
    estimates = drone.own
    capture = drone.captured
    pose = with_motion(sample.captured, capture.pose, sample.own)
    newer = capture.update(pose, tick, drone.estimate)
    if newer.pose is pose:
        feeds = True
        # on the ground, or with no pose of its own, there is nothing to compare it with
        if tick.moving and estimates.pose is not None:
            offset = offset_of(pose, estimates.pose)
            feeds = offset.is_error(tick.limits)
            if estimates.fresh(tick) and not offset.is_agreement(tick.limits):
                newer = newer._replace(pose=capture.pose, verdict=Verdict.APART)
        drone = drone._replace(feeds_estimator=feeds)
    newer = capture.check_motion(newer, tick)
    if tick.moving and not newer.fault and not newer.fresh(tick):
        newer = newer._replace(fault=newer.verdict or "pose lost")
    return drone._replace(captured=newer)
