"""The estimate of each vehicle, brought to the present by those of its poses that
can be believed.
"""

import math
from collections.abc import Sequence

from openjax.flying.controller import Pose, level_acceleration, moved_on
from openjax.flying.drift import drifting
from openjax.flying.innovations import Innovations
from openjax.flying.judge import PoseHistory, Verdict, agree, follows
from openjax.flying.set_point import as_sent
from openjax.flying.state import FLYING, SPIN_UP, Drone, Mode, PoseSample, State

CHECKED = (Mode.TRANSFER, Mode.READY, Mode.PURSUIT, Mode.HOLD, Mode.LAND)
"""Modes in which nothing but air carries a vehicle, so that thrust tells its
acceleration.
"""
SMOOTHING = 0.02
"""Time constant of the low-pass of velocities from motion capture (s)."""


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
    drift = drifting([drone.innovations.drift for drone in drones])
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
    if drone.contradiction or drone.mode not in CHECKED:
        return drone
    pose = drone.innovations.pose
    excess = (*drone.innovations.drift.totals, 0.0)
    velocity = tuple(v - part for v, part in zip(pose.velocity, excess, strict=True))
    return drone._replace(
        own=drone.own._replace(verdict=Verdict.DRIFTS),
        contradiction=Verdict.DRIFTS,
        estimate=moved_on(pose._replace(velocity=velocity), state.time),
    )


def _estimate(state, drone, sample) -> Drone:
    """The drone with its estimate now, after what was newly told of it."""
    time = state.time
    limits = state.limits
    moving = drone.mode in FLYING and not (drone.mode is Mode.LIFT and time - drone.since < SPIN_UP)
    by_capture = sample.captured is not None and not drone.capture_fault
    track = _onboard_track(state, drone, sample, by_capture, moving)
    drone = _consistent(state, drone, track, sample.force)
    if by_capture and not drone.capture_fault:
        drone = _with_capture(state, drone, sample, moving)
    source = drone.captured if by_capture and not drone.capture_fault else drone.own
    is_contradiction = source is drone.own and drone.contradiction
    if source.fresh(time, limits) and not is_contradiction:
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


def _consistent(state, drone, own_track, force) -> Drone:
    """The drone after its newest own estimate, with what its accelerometer feels.

    If its innovations contradict that, none is believed any more in this flight, nor
    motion capture where it tells the same: what the estimator on board follows can't
    confirm it.
    """
    if drone.contradiction:
        return drone._replace(own=drone.own._replace(verdict=drone.contradiction))
    if drone.mode not in CHECKED:
        return drone._replace(own=own_track, innovations=Innovations())
    if own_track.pose is drone.own.pose:
        # what told nothing but wrong poses until it was lost may tell believable ones,
        # of another place, once anything can have happened
        verdict_lost = own_track.verdict and not any(
            track.fresh(state.time, state.limits) for track in (own_track, drone.captured)
        )
        return drone._replace(
            own=own_track, contradiction=own_track.verdict if verdict_lost else Verdict.GOOD
        )
    is_refused = bool(drone.own.verdict)
    innovations = drone.innovations.update(
        own_track.pose, as_sent(drone.sent), state.airframe, is_refused
    )
    innovations = innovations.feeling(force)
    verdict = innovations.verdict()
    capture = drone.captured
    if not verdict:
        return drone._replace(own=own_track, innovations=innovations)
    drone = drone._replace(
        own=drone.own._replace(verdict=verdict), innovations=innovations, contradiction=verdict
    )
    # motion capture tells otherwise than the estimate, so it isn't what the estimate
    # followed
    if capture.pose is not None and not follows(capture.pose, own_track.pose, state.limits):
        return drone
    # neither is believed any more: back to where the sums say that the vehicle is
    estimate = moved_on(innovations.corrected_pose(), state.time)
    return drone._replace(estimate=estimate, capture_fault=verdict)


def _onboard_track(state, drone, sample, by_capture, moving) -> PoseHistory:
    """The drone's own estimates after the newest one, which motion capture must confirm
    where they were lost or wrong.
    """
    time = state.time
    limits = state.limits
    track = drone.own
    if by_capture and track.fresh(time, limits):
        # what it is flown by is motion capture: that says nothing of where its own
        # leads
        return track.update(sample.own, time, limits, moving, None)
    next_track = track.update(sample.own, time, limits, moving, drone.estimate)
    capture = drone.captured
    to_confirm = (
        moving and by_capture and next_track.pose is not track.pose and capture.fresh(time, limits)
    )
    if to_confirm and agree(capture.pose, next_track.pose, limits) is Verdict.APART:
        return next_track._replace(pose=track.pose, verdict=Verdict.JUMPED)
    return next_track


def _with_capture(state, drone, sample, moving) -> Drone:
    """The drone after the newest of motion capture: whether it is believed, and told to
    the estimator on board.
    """
    time = state.time
    limits = state.limits
    estimates = drone.own
    capture = _with_motion(sample.captured, drone.captured.pose, sample.own)
    track = drone.captured.update(capture, time, limits, moving, drone.estimate)
    capture_fault = ""
    if track.pose is capture:
        # on the ground, or with no pose of its own, there is nothing to compare it with
        comparable = moving and estimates.pose is not None
        feeds = not comparable or follows(capture, estimates.pose, limits)
        drone = drone._replace(feeds_estimator=feeds)
        verdict = Verdict.GOOD
        if comparable and estimates.fresh(time, limits):
            verdict = agree(capture, estimates.pose, limits)
        if verdict:
            track = track._replace(pose=drone.captured.pose, verdict=verdict)
    innovations = drone.captured_innovations
    if drone.mode not in CHECKED:
        innovations = Innovations()
    elif track.pose is capture and capture is not drone.captured.pose:
        is_refused = bool(drone.captured.verdict)
        innovations = innovations.update(capture, as_sent(drone.sent), state.airframe, is_refused)
        capture_fault = innovations.verdict()
    if capture_fault:
        track = track._replace(pose=drone.captured.pose, verdict=capture_fault)
    elif moving and not track.fresh(time, limits):
        capture_fault = track.verdict or "pose lost"
    return drone._replace(
        captured=track, captured_innovations=innovations, capture_fault=capture_fault
    )


def _with_motion(pose, last, estimate) -> Pose:
    """A pose of motion capture with the velocity from differences, smoothed, and the
    body rates of the gyroscope.
    """
    if last is None or pose.time <= last.time:
        return pose if last is None else last
    if (pose.position, pose.quaternion) == (last.position, last.quaternion):
        return last._replace(time=pose.time)  # which is judged frozen
    step = pose.time - last.time
    # differences of poses that are off by a millimetre jump by .1 m/s at 100 Hz
    share = 1.0 - math.exp(-step / SMOOTHING)
    velocity = tuple(
        v + share * ((p - q) / step - v)
        for p, q, v in zip(pose.position, last.position, last.velocity, strict=True)
    )
    return pose._replace(
        velocity=velocity, body_rates=pose.body_rates if estimate is None else estimate.body_rates
    )
