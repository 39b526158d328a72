"""Faults of a flight where they happen: in what a camera or a radio sends, in a link, a
policy, a process, a key.

A fault is drawn from its number: kind, moment, vehicle, amount. `PoseDamage` does to
poses what the kind says.
"""

from __future__ import annotations

import math
import random
from collections import defaultdict, deque
from dataclasses import dataclass

import numpy as np

from openjax.flying.controller import Pose
from openjax.flying.state import SafetySettings

FOLLOWED = "camera drifts, the estimator follows"
"""A limit: with nothing on board that sees the floor, a slow drift looks like a tilt
that is wrong by two degrees.
"""
ASLEEP = "all processes stand still for a while"
"""Another: meanwhile vehicles turn on as they were told last, then level, then stop."""
BEYOND = (FOLLOWED, ASLEEP)
"""What nothing in these processes can mend."""
GONE = ("drone gone", "link lost for a while", "drone restarts")
"""Nothing reaches that vehicle nor comes from it, which may cost it; the others it
mustn't.
"""
CAMERA = (
    "camera lost", "camera lost for a while", "camera frozen", "camera frozen, all", "camera: one frame wrong",
    "camera: four frames wrong", "camera moved", "camera: a number that is none", "camera: no attitude",
    "camera: yaw turned", "camera: y up", "camera: bodies swapped", "camera scaled", "camera late", "camera restarts",
    "camera: clock steps", "camera drifts", FOLLOWED,
)  # fmt: skip
RADIO = (
    "poses lost", "poses lost for a while", "packets lost", "poses frozen", "poses jump",
    "poses: a number that is none", "gyroscope: a number that is none", "poses: no attitude", "poses out of order",
    "poses: clock steps",
)  # fmt: skip
WILD = {
    "policy wild": lambda tick, n, shape: np.random.default_rng(10 * tick + n).uniform(
        -1.0, 1.0, shape
    ),
    "policy huge": lambda tick, n, shape: np.random.default_rng(n).choice((-1e30, 1e30), shape),
    "policy alternating": lambda tick, n, shape: (
        np.random.default_rng(n).choice((-1.0, 1.0), shape) * (-1) ** (tick // (1 + n % 5))
    ),
}
"""The policy's action (N, 4) at a tick of flight n: drawn anew; one extreme for good;
from one to the other.
"""
OTHER = (
    "loop stopped", "links stopped", "guard stopped", "loop and links stopped", "loop and guard stopped",
    "policy silent", "policy: a number that is none", *WILD, "battery low", "battery unknown", *GONE, "key", ASLEEP,
)  # fmt: skip
KINDS = (*CAMERA, *RADIO, *OTHER)
PASSING = ("poses jump", "camera: yaw turned", "camera: bodies swapped")
"""These may be over after a moment, as those of numbers that are none and of
attitudes.
"""
START = 0.2
"""Nothing goes wrong before (s)."""
MARGIN = 0.1
FALL = 0.3
ENDING = 5.0
"""Out of the arena by more (m) is out; motors off above (m) is a fall; a flight must be
over so long (s) after what ends it.
"""


@dataclass(frozen=True)
class Fault:
    """What goes wrong, when (s), with which vehicle, for how long (s), how much, in
    which direction.
    """

    kind: str
    time: float
    vehicle: int
    duration: float = math.inf
    amount: float = 0.0
    direction: float = 0.0
    number: float = math.nan

    @property
    def captured(self) -> bool:
        """Whether there is motion capture in this flight."""
        return self.kind in CAMERA or self.direction < math.pi

    def losses(self, now: float) -> tuple[float, float]:
        """Shares of a vehicle's set-points, and of what it sends, that are lost at
        `now` (s).
        """
        loss = float(self.kind in GONE)
        up, down = {
            "packets lost": (self.amount,) * 2,
            "poses lost": (0.0, 1.0),
            "poses lost for a while": (0.0, 1.0),
        }.get(self.kind, (loss, loss))
        return up * self.on(now), down * self.on(now)

    def answered(self, action: np.ndarray, now: float) -> np.ndarray | None:
        """What the policy is said to have answered (N, 4) at `now` (s) in place of
        `action`; None: nothing.
        """
        if not self.on(now) or not self.kind.startswith("policy"):
            return action
        if self.kind in WILD:
            return WILD[self.kind](
                round(100 * now), self.vehicle + round(100 * self.time), action.shape
            )
        # as networks answer: larger numbers are infinite
        action = np.array(action, np.float32)
        with np.errstate(over="ignore"):
            action[self.vehicle, round(100 * self.time) % 4] = self.number
        return None if self.kind == "policy silent" else action

    def on(self, now: float) -> bool:
        """Whether it is there at `now` (s)."""
        return 0.0 <= now - self.time < self.duration


def draw_fault(seed: int, latest: float) -> Fault:
    """The fault number `seed`, which begins by `latest` (s); the kinds take turns. None
    below zero.
    """
    if seed < 0:
        return Fault("none", math.inf, 0)
    rng = random.Random(seed)
    kind = KINDS[seed % len(KINDS)]
    time = rng.uniform(START, latest)
    vehicle = rng.randrange(3)
    direction = rng.uniform(0.0, 2.0 * math.pi)
    number = rng.choice((math.nan, math.inf, -math.inf, 1e300))
    duration = {"camera: one frame wrong": 0.0099, "camera: four frames wrong": 0.0399}.get(
        kind, math.inf
    )
    if kind.endswith("for a while"):
        duration = rng.uniform(0.05, 1.0)
    elif "none" in kind or "attitude" in kind or kind in PASSING:
        duration = rng.choice((0.0099, 0.05, 1.0, math.inf))
    amount = {
        "packets lost": rng.uniform(0.1, 0.7), "camera scaled": rng.choice((0.8, 1.2, 1.5, 1000.0)),
        "camera late": rng.uniform(0.02, 0.4), "camera drifts": rng.uniform(0.1, 0.5), FOLLOWED: rng.uniform(0.1, 0.5),
    }.get(kind, rng.choice((0.14, 0.3, 0.5, 2.0)))  # fmt: skip
    return Fault(kind, time, vehicle, duration, amount, direction, number)


class PoseDamage:
    """What is received in place of a vehicle's true poses, camera's or radio's."""

    def __init__(self, fault: Fault):
        self._fault, self._random = fault, random.Random(fault.time)
        self._held: dict[tuple, Pose] = {}
        self._past = defaultdict(lambda: deque(maxlen=50))
        self._field = self._random.randrange(100)

    def __call__(self, source: str, i: int, now: float, pose: Pose, others) -> Pose | None:
        """The pose received from `source`, "camera" or "radio"; `others`: true poses of
        all.
        """
        fault = self._fault
        self._past[source, i].append(pose)
        # from the start it is the whole system
        mine = i == fault.vehicle or fault.kind.endswith("all") or fault.time < 0.0
        if fault.kind in GONE and mine and fault.on(now) and source == "radio":
            return None
        names = CAMERA if source == "camera" else RADIO
        if fault.kind not in names or not mine or not fault.on(now):
            self._held[source, i] = pose
            return pose
        return self._damaged(fault.kind.replace("poses", "camera"), source, i, now, pose, others)

    def _damaged(self, kind, source, i, now, pose, others):
        fault = self._fault
        what = kind.removeprefix("camera").removeprefix(":").strip()
        away = (
            fault.amount * math.cos(fault.direction),
            fault.amount * math.sin(fault.direction),
            0.0,
        )
        since = now - fault.time
        if what.startswith("lost"):
            return None
        if kind == "packets lost":
            return None if self._random.random() < fault.amount else pose
        if what.startswith("frozen"):
            return self._held.get((source, i), pose)._replace(time=now)
        if what in ("one frame wrong", "four frames wrong", "moved", "jump"):
            return _shifted(pose, away, 1.0)
        if what.startswith("drifts"):
            return _shifted(pose, away, since)
        if what == "scaled":
            return pose._replace(position=tuple(fault.amount * p for p in pose.position))
        if what == "no attitude":
            return pose._replace(quaternion=(0.0,) * 4)
        w, x, y, z = pose.quaternion
        if what == "yaw turned":
            return pose._replace(quaternion=(-z, y, -x, w))
        if what == "y up":
            right, ahead, up = pose.position
            return pose._replace(position=(right, up, -ahead), quaternion=(w, x, z, -y))
        if what == "bodies swapped":
            other = others[(i + 1) % len(others)]
            return pose._replace(position=other.position, quaternion=other.quaternion)
        if what == "late":
            return self._earlier(source, i, round(100 * fault.amount))._replace(time=now)
        if what == "restarts":
            return None if since < 0.5 * fault.amount else _shifted(pose, away, 1.0)
        if what == "clock steps":
            return pose._replace(
                time=pose.time + math.copysign(fault.amount, math.cos(fault.direction))
            )
        if what == "out of order":
            return self._earlier(source, i, self._random.randrange(4))
        name = (
            "body_rates"
            if kind.startswith("gyroscope")
            else ("position", "quaternion")[self._field % 2]
        )
        values = list(getattr(pose, name))
        values[self._field % len(values)] = fault.number
        return pose._replace(**{name: tuple(values)})

    def _earlier(self, source, i, ticks) -> Pose:
        past = self._past[source, i]
        return past[max(len(past) - 1 - ticks, 0)]


def _shifted(pose: Pose, away, share: float) -> Pose:
    return pose._replace(
        position=tuple(p + share * a for p, a in zip(pose.position, away, strict=True))
    )


def outcome(fault: Fault, times, position, off, begin: float) -> dict:
    """What became of the vehicles from `begin` (s) on; of one that is gone itself
    nothing is asked.

    times (T,), position (T, N, 3) m and off (T, N), motors off, are the truth. `out`:
    farthest beyond arena or ceiling (m); infinite where a position is no number.
    `seconds` until all stayed on the floor with their motors off, None if they didn't;
    `held`: (N,) whom one can hold.
    """
    is_held = (np.arange(off.shape[1]) != fault.vehicle) | (fault.kind not in GONE)
    is_after = times >= begin
    times = times[is_after]
    position = position[is_after][:, is_held]
    off = off[is_after][:, is_held]
    height = position[..., 2]
    limits = SafetySettings()
    sideways = np.linalg.norm(position[..., :2], axis=-1) - limits.arena_radius
    up = np.flatnonzero(~(off & (height < 0.02)).all(1))
    first = up[-1] + 1 if len(up) else 0
    out = np.maximum(sideways, height - limits.arena_height).max(initial=-1.0)
    return {
        "out": round(math.inf if np.isnan(position).any() else float(out), 3),
        "fell": bool((off & (height > FALL)).any()),
        "seconds": float(times[first] - begin) if first < len(times) else None,
        "held": is_held,
    }


def finite(row: dict) -> dict:
    """A row as JSON has it: null for what is no finite number, and in `not_finite` what
    that was.
    """
    odd = {name: str(x) for name, x in row.items() if isinstance(x, float) and not math.isfinite(x)}
    return {**row, **dict.fromkeys(odd), "not_finite": odd} if odd else row


SLOW = (
    "packets lost",
    "poses out of order",
    "camera scaled",
    "camera late",
    "camera drifts",
    FOLLOWED,
)
"""These may take effect long after they begin."""


def well(row: dict) -> bool:
    """Whether a flight ended as it must."""
    in_time = row["seconds"] is None or row["seconds"] <= ENDING or row["kind"] in SLOW
    return row["out"] <= MARGIN and not (row["fell"] or row["hard"] or row["armed"]) and in_time
