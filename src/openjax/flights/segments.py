"""Segments of flight that tell causes apart, and the plan of two minutes made of them.

Each excites what others leave still: turning on the spot, agility, steps, climbs, fast
passes in two headings, the floor, the ceiling, and a hover on a used battery. All stay
within a box that the safety of `openjax fly` allows.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openjax.flights.manoeuvres import PERIOD, Reference

RADIUS = 0.7  # m around the middle
LOWEST = 0.14  # m, just above the floor that `openjax fly` keeps
HIGHEST = 1.1  # m
MIDDLE = 0.6  # m
EASE = 1.5  # s in which a segment begins and ends, at the middle
DITHER = 0.5  # rad/s, pseudo-random on top of what tracking asks for
HELD = (0.04, 0.16)  # s, shortest and longest that it holds: 3 to 12 Hz
# of thrust (share of the largest) and body rates, rad/s
DOUBLETS = (0.08, 1.5, 1.5, 1.0)
FULL = 4.0  # V, open circuit
EMPTY = 3.6  # V, of a battery that is nearly spent


@dataclass(frozen=True)
class Segment:
    """A piece of flight that begins and ends in the middle."""

    seconds: float
    shows: str
    """Its description, in words."""
    path: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    """path(t, ease): position (T, 3) m and yaw (T,) rad."""
    commands: Callable[[np.ndarray], np.ndarray] | None = None
    """commands(t): what is added to the commands (T, 4); None: nothing."""
    voltage: float = FULL
    """Of the battery, open circuit (V)."""

    def reference(self, seconds: float | None = None) -> Reference:
        """The reference of one vehicle, from the middle back to the middle."""
        t = np.arange(0.0, seconds or self.seconds, PERIOD)
        ease = np.clip(np.minimum(t, t[-1] - t) / EASE, 0.0, 1.0)
        # a minimum-jerk step: velocity and acceleration begin and end at zero
        ease = ease**3 * (10.0 - 15.0 * ease + 6.0 * ease**2)
        position, yaw = self.path(t, ease[:, None])
        extra = np.zeros((len(t), 4)) if self.commands is None else self.commands(t)
        extra = np.where(ease[:, None] > 0.99, extra, 0.0)
        return Reference(position[:, None], yaw[:, None], extra[:, None], self.voltage)


def _at(x, y, z) -> np.ndarray:
    return np.stack(np.broadcast_arrays(x, y, z), -1).astype(float)


def _middle(t):
    return _at(0.0 * t, 0.0, MIDDLE)


def _dither(t: np.ndarray) -> np.ndarray:
    """Commands (T, 4): body rates that jump between -1, 0 and 1 times DITHER at random
    moments, the same in every flight.
    """
    rng = np.random.default_rng(1)
    out = np.zeros((len(t), 4))
    for axis in (1, 2, 3):
        row = 0
        while row < len(t):
            hold = max(int(rng.uniform(*HELD) / PERIOD), 1)
            out[row : row + hold, axis] = DITHER * rng.choice([-1.0, 0.0, 1.0])
            row += hold
    return out


def _doublets(t: np.ndarray) -> np.ndarray:
    """Commands (T, 4): every half second a step there and one back, on each axis in
    turn and then with the other sign.
    """
    out = np.zeros((len(t), 4))
    for number, begin in enumerate(np.arange(EASE, t[-1] - EASE, 0.5)):
        axis = number % 4
        sign = 1.0 if number // 4 % 2 else -1.0
        half = 0.08
        inside = (t >= begin) & (t < begin + 2.0 * half)
        out[inside, axis] = sign * DOUBLETS[axis] * np.where(t[inside] < begin + half, 1.0, -1.0)
    return out


def _turning(t, ease):
    return _middle(t), 2.5 * np.sin(2.0 * np.pi * 0.12 * t) * ease[:, 0]


def _agile(t, ease):
    turn = 2.0 * np.pi * t
    path = ease * _at(
        0.5 * np.sin(0.4 * turn), 0.5 * np.sin(0.33 * turn), 0.22 * np.sin(0.25 * turn)
    )
    return _middle(t) + path, 0.8 * np.sin(0.11 * turn) * ease[:, 0]


def _rest(t, ease):
    return _middle(t), 0.0 * t


def _climbing(t, ease):
    height = 0.5 * (HIGHEST - 0.15 + 0.35) - MIDDLE + 0.3 * np.sin(2.0 * np.pi * 0.5 * t)
    return _middle(t) + ease * _at(0.0 * t, 0.0, height), 0.0 * t


def _fast(t, ease):
    along = RADIUS * np.sin(2.0 * np.pi * 0.3 * t)
    progress = np.clip((t - 0.5 * t[-1]) / 1.0 + 0.5, 0.0, 1.0)
    yaw = 0.5 * np.pi * progress**2 * (3.0 - 2.0 * progress) * ease[:, 0]
    return _middle(t) + ease * _at(along, 0.0, 0.0), yaw


def _level(height):
    def path(t, ease):
        over = 0.4 * np.sin(2.0 * np.pi * 0.15 * t)
        return _middle(t) + ease * _at(over, 0.0, height - MIDDLE), 0.0 * t

    return path


SEGMENTS: dict[str, Segment] = {
    "yaw": Segment(20.0, "turning on the spot with small random body rates", _turning, _dither),
    "agile": Segment(20.0, "a quick figure with small random body rates", _agile, _dither),
    "step": Segment(20.0, "doublets of thrust and of every body rate in hover", _rest, _doublets),
    "climb": Segment(15.0, "quick climbs and descents", _climbing),
    "fast": Segment(20.0, "fast straight passes, nose first and side first", _fast),
    "low": Segment(10.0, "slow passes just above the floor", _level(LOWEST)),
    "high": Segment(10.0, "slow passes just below the ceiling", _level(HIGHEST)),
    "hover": Segment(5.0, "hovering on a used battery", _rest, None, EMPTY),
}
"""By name; all of them, in this order, are the standard plan of two minutes."""
