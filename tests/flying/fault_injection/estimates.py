"""Estimates that go wrong so gently that no single pose shows it.

Three vehicles hunt in simulated time, as in `fault_worlds`, by their own estimates alone or, where a
camera goes wrong, by its poses, which the estimators on board follow.
"""

from __future__ import annotations

import math
import random

from openjax.flying.controller import Pose
from tests.flying.fault_injection.fault_worlds import LATEST, SECONDS, Worlds
from tests.flying.fault_injection.faults import ENDING, MARGIN, Fault

ALONE = 4.0
CAPTURED = 1.0
"""Directions (rad) that say whether there is motion capture, see `Fault.captured`."""
AMOUNTS = (0.1, 0.2, 0.3, 0.5)


class EstimateDamage:
    """What is received in place of a vehicle's true poses."""

    def __init__(self, fault: Fault):
        self._fault = fault
        self._random = random.Random(fault.time)
        self._held: Pose | None = None

    def __call__(self, source: str, i: int, now: float, pose: Pose, others) -> Pose:
        """As `PoseDamage`."""
        fault = self._fault
        damaged = "camera" if fault.captured else "radio"
        if source != damaged or i != fault.vehicle:
            return pose
        if self._held is None or not fault.on(now):
            self._held = pose
            return pose
        return DAMAGES[fault.kind](self, pose, now - fault.time)

    def noisy(self, values, deviation: float) -> tuple[float, ...]:
        """Values with noise."""
        return tuple(value + self._random.gauss(0.0, deviation) for value in values)

    def moved(self, pose: Pose, way: float, speed: float = 0.0, height: bool = False) -> Pose:
        """A pose shifted by `way`, its velocity by `speed`, each times the fault's
        amount.
        """
        fault = self._fault
        angle = 40.0 * fault.time  # drawn
        level = (math.cos(angle), math.sin(angle), 0.0)
        axis = (0.0, 0.0, math.copysign(1.0, level[0])) if height else level
        away = [fault.amount * part for part in axis]
        return pose._replace(
            position=tuple(p + way * a for p, a in zip(pose.position, away, strict=True)),
            velocity=tuple(v + speed * a for v, a in zip(pose.velocity, away, strict=True)),
        )

    def frozen(self, pose: Pose, gyroscope: bool, velocity: bool) -> Pose:
        """The pose as it was, with 2 mm of noise; the gyroscope may live, the velocity
        be zero.
        """
        memory = self._held
        rates = pose.body_rates if gyroscope else self.noisy(memory.body_rates, 0.02)
        return memory._replace(
            time=pose.time,
            position=self.noisy(memory.position, 0.002),
            velocity=self.noisy(memory.velocity if velocity else (0.0, 0.0, 0.0), 0.005),
            quaternion=_unit(self.noisy(memory.quaternion, 0.001)),
            body_rates=rates,
        )

    def blended(self, pose: Pose, t: float) -> Pose:
        """From the true pose to the one that is held, within 1.2 to 2 s."""
        share = min(t / (1.0 + 2.0 * self._fault.amount), 1.0)
        parts = {
            name: tuple(
                a + share * (b - a)
                for a, b in zip(getattr(pose, name), getattr(self._held, name), strict=True)
            )
            for name in ("position", "velocity", "quaternion")
        }
        return pose._replace(**{**parts, "quaternion": _unit(parts["quaternion"])})

    def scaled(self, pose: Pose) -> Pose:
        """Ways that are too long."""
        share = self._fault.amount
        away = zip(pose.position, self._held.position, strict=True)
        return pose._replace(position=tuple(p + share * (p - h) for p, h in away))


def _unit(quaternion) -> tuple[float, ...]:
    size = math.hypot(*quaternion)
    return tuple(q / size for q in quaternion)


def _gently(t: float) -> tuple[float, float]:
    """Way (s) and speed of a drift that sets in within 2 s."""
    return (0.25 * t * t, 0.5 * t) if t < 2.0 else (t - 1.0, 1.0)


SWING = 2.0
"""rad/s"""
DAMAGES = {
    "position drifts": lambda d, pose, t: d.moved(pose, t),
    "height drifts": lambda d, pose, t: d.moved(pose, t, height=True),
    "position wanders": lambda d, pose, t: d.moved(pose, math.sin(SWING * t)),
    "ways are too long": lambda d, pose, t: d.scaled(pose),
    "velocity is held": lambda d, pose, t: pose._replace(velocity=d._held.velocity),
    "velocity is zero": lambda d, pose, t: pose._replace(velocity=d.noisy((0.0,) * 3, 0.01)),
    "frozen, 2 mm of noise": lambda d, pose, t: d.frozen(pose, False, True),
    "frozen, the gyroscope lives": lambda d, pose, t: d.frozen(pose, True, True),
    "frozen, at rest": lambda d, pose, t: d.frozen(pose, False, False),
    "blends into a held pose": lambda d, pose, t: d.blended(pose, t),
    "camera blends into a held pose": lambda d, pose, t: d.blended(pose, t),
    "drifts with its velocity": lambda d, pose, t: d.moved(pose, t, 1.0),
    "height drifts with its velocity": lambda d, pose, t: d.moved(pose, t, 1.0, height=True),
    "drifts gently with its velocity": lambda d, pose, t: d.moved(pose, *_gently(t)),
    "height drifts gently with its velocity": lambda d, pose, t: d.moved(
        pose, *_gently(t), height=True
    ),
}
"""(damage, true pose, seconds since it began) -> what is received, by kind."""
UNTOLD = tuple(kind for kind in DAMAGES if "with its velocity" in kind)
"""What nothing on board can tell where it is small, or sets in gently along the ground;
teammates tell some of that, and the accelerometer some of the height.
"""
TOLD = tuple(kind for kind in DAMAGES if kind not in UNTOLD)


def draw(kind: str, seed: int, later: float = 0.0) -> Fault:
    """A fault of a kind that begins `later` (s) than usual: until then a vehicle learns what
    is usual in the air.
    """
    rng = random.Random(f"{kind} {seed}")
    return Fault(
        kind,
        later + rng.uniform(0.3, LATEST),
        rng.randrange(3),
        amount=rng.choice(AMOUNTS),
        direction=CAPTURED if kind.startswith("camera") else ALONE,
    )


def fly(kinds, seeds, layout: str, policy: str, later: float = 0.0) -> list[dict]:
    """Fly one fault of each kind for each seed, side by side; a record of each."""
    faults = [draw(kind, seed, later) for seed in seeds for kind in kinds]
    worlds = Worlds(faults, layout, policy, EstimateDamage)
    for _ in range(round((SECONDS + ENDING) / 0.01)):
        if not worlds.tick():
            break
    return worlds.records([seed for seed in seeds for _ in kinds])


def well(row: dict) -> bool:
    """Whether a flight ended as it must; a small drift may take its time."""
    return row["out"] <= MARGIN and not (row["fell"] or row["hard"] or row["armed"])
