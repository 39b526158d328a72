"""Before take-off: what must be so, each failure a line that says what to do."""

import math
import time
from collections.abc import Iterator, Sequence

from openjax.flying.controller import Vector, roll_pitch_yaw, up
from openjax.flying.crtp import Supervisor
from openjax.flying.judge import judge, offset_of
from openjax.flying.member import PERIOD_MS
from openjax.flying.state import PoseSample, State

LISTENING = 0.5
"""Time (s) for which poses are counted."""
READING = 0.02
"""After so long (s) they're read: some 270 poses fit into what leads here, a third of a
second of eight vehicles, and those that find it full are lost.
"""
POSE_RATE = 1000.0 / PERIOD_MS
"""Own estimates that a vehicle sends a second (Hz)."""
LEAST_SHARE = 0.8
"""Least share of these that must arrive: a vehicle lands after 60 ms without one, and
.2**6 of the time six in a row are lost.
"""
MOST_TILT = math.radians(10.0)
"""More tilted (rad) than a floor, or a body marked by hand, is ever off level."""
MOST_YAW = math.radians(30.0)
"""A vehicle stands along x to within this angle (rad): as well as somebody can see."""
MOST_HEIGHT = 0.1
"""It stands no higher or lower than this (m): its poses call the floor zero."""


def poses_arriving(links) -> list[float]:
    """Each vehicle's own estimates a second of its own time (Hz)."""

    def newest():
        times = [sample.own.time for sample in links.observe()]
        return list(zip(times, links.counts, strict=True))

    # what has waited: it may have been full
    links.observe()
    time.sleep(READING)
    earlier = newest()
    for _ in range(round(LISTENING / READING)):
        time.sleep(READING)
        links.observe()
    # by the times at which poses were measured, since the sleep may have taken longer
    return [
        (count - old_count) / max(at - since, LISTENING)
        for (at, count), (since, old_count) in zip(newest(), earlier, strict=True)
    ]


def faults(
    state: State, samples: Sequence[PoseSample], rates: Sequence[float], has_guard: bool
) -> list[str]:
    """Reasons against taking off, a line each; vehicles are counted from 0 in the order of --uri.

    Args:
      state: before the flight, for starts and settings.
      samples: what is known of each vehicle.
      rates: of each vehicle's poses (Hz).
      has_guard: whether a guard watches, or none is wanted.
    """
    lines = []
    if not has_guard:
        lines.append("the guard's process isn't there; try again, with fewer programs running")
    for i, (sample, start, rate) in enumerate(zip(samples, state.starts, rates, strict=True)):
        pose_faults = [
            *_firmware_faults(state.settings, sample, rate),
            *_pose_faults(state, sample, start),
        ]
        lines += [f"vehicle {i}: {fault}" for fault in pose_faults]
    return lines


def _firmware_faults(settings, sample, rate) -> Iterator[str]:
    """Reasons by its firmware, battery and link. Of the firmware's bits the first fault only: the
    others follow from it.
    """
    bits = sample.supervisor
    if bits & (Supervisor.TUMBLED | Supervisor.CRASHED):
        yield "its firmware says tumbled or crashed; look at it, put it upright, restart it"
    elif bits & Supervisor.LOCKED:
        yield "its firmware is locked after an emergency stop; restart it"
    elif bits & Supervisor.FLYING or (bits & Supervisor.ARMED and not bits & Supervisor.AUTO_ARM):
        yield "it is armed or flies already; end the program that commands it"
    elif not bits & (Supervisor.CAN_BE_ARMED | Supervisor.CAN_FLY):
        yield "its firmware can't be armed; look at its console"
    if not sample.voltage >= settings.battery_start:  # true of an unknown voltage, too
        least = f"{settings.battery_start:g} V"
        yield f"battery at {sample.voltage:.2f} V; charge it to {least} or more"
    if rate < LEAST_SHARE * POSE_RATE:
        yield (
            f"{rate:.0f} of {POSE_RATE:.0f} poses a second arrive; bring the antenna nearer or "
            "change the channel"
        )


def _pose_faults(state, sample, start: Vector) -> Iterator[str]:
    """Reasons by its poses. A pose that can't be one hides all else."""
    # motion capture says where a vehicle is, where there is one: the own estimate follows it
    pose = sample.captured or sample.own
    limits = state.limits
    for source in (sample.own, sample.captured):
        if source is not None and (verdict := judge(source, None, 0.0, limits)):
            yield f"{verdict}; look at the positioning system"
            return
    x, y, z = pose.position
    spot = f"({x:.2f}, {y:.2f}, {z:.2f})"
    if math.dist((x, y), start[:2]) > state.settings.stand or abs(z) > MOST_HEIGHT:
        yield (
            f"stands at {spot} m, its mark is ({start[0]:.2f}, {start[1]:.2f}, 0): put it "
            "there, or correct the positioning system's axes, origin or unit"
        )
    if up(pose.quaternion) < math.cos(MOST_TILT):
        yield "doesn't stand level; put it upright, or correct the body's axes"
    elif abs(roll_pitch_yaw(pose.quaternion)[2]) > MOST_YAW:
        yield "doesn't face +x; turn it, or correct the body's axes"
    if sample.captured is None or sample.own is None:
        return
    if not offset_of(sample.captured, sample.own).is_agreement(limits):
        place = ", ".join(f"{p:.2f}" for p in sample.own.position)
        yield (
            f"motion capture sees it at {spot} m, its own estimate at ({place}): correct axes, "
            "unit or origin of one of them"
        )
