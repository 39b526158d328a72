"""Detect a gentle drift of a vehicle's estimated velocity by comparison with its teammates.

While a drift sets in, the estimate accelerates as thrust and attitude don't explain. So do the
air's drag, which nobody told the vehicle, and an attitude that is off by a tenth of a degree. A
constant and a drag for each level axis are therefore learnt in flight, by least squares that forget
(Ljung 1999, "System identification", 11.2), and what they leave is summed up. How large such sums
are where nothing drifts, the teammates say: they fly alike, in the same air.

The height is left out. There the floor's cushion, another vehicle's wake and an emptier battery
accelerate by more than a drift does.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from openjax.flying.controller import Vector

WINDOW = 1.5
"""What constant and drag leave is summed up over this time constant (s): a gentle drift
takes about as long to set in.
"""
FORGETTING = 6.0
"""Time constant (s) with which constant and drag are learnt: longer than the window, or
they learn the drift.
"""
LEARNT = 4.0
"""In the first of a flight (s) the sums don't count: they say how badly constant and
drag are known yet.
"""
SPREAD = 0.05
"""Information that never fades, so that a vehicle at rest is taken to have no drag (m^2/s^2)."""
FLOOR = 0.15
"""Smaller sums (m/s) are no drift, whatever the teammates' are: an attitude's error of
.2 degrees that comes within the window accelerates by .05 m/s.
"""
RATIO = 4.0
"""Nor are sums that aren't so many times the teammates' root mean square: of flights of
30 s without a drift, at most one in fifty was ended (experiments/results/flying.md).
"""


class Fit(NamedTuple):
    """Constant and drag of one level axis: sums of least squares."""

    time: float = 0.3  # s
    way: float = 0.0  # of the velocity, m
    energy: float = 0.3  # of its square, m^2/s
    gain: float = 0.0  # of the acceleration, m/s
    moment: float = 0.0  # of their product, m^2/s^2

    def update(self, acceleration: float, velocity: float, dt: float) -> "Fit":
        """With what was unexplained for `dt` (s) at a velocity (m/s)."""
        decay = math.exp(-dt / FORGETTING)
        return Fit(
            decay * self.time + dt + (1.0 - decay) * SPREAD,
            decay * self.way + dt * velocity,
            decay * self.energy + dt * velocity**2 + (1.0 - decay) * SPREAD,
            decay * self.gain + dt * acceleration,
            decay * self.moment + dt * acceleration * velocity,
        )

    def at(self, velocity: float) -> float:
        """The acceleration (m/s^2) that is usual at a velocity (m/s)."""
        # the normal equations of a straight line, whose sums fade
        determinant = self.time * self.energy - self.way**2
        constant = self.energy * self.gain - self.way * self.moment
        slope = self.time * self.moment - self.way * self.gain
        return (constant + slope * velocity) / determinant


class Drift(NamedTuple):
    """The part of a vehicle's level velocity that nothing explains."""

    fits: tuple[Fit, Fit] = (Fit(), Fit())
    totals: tuple[float, float] = (0.0, 0.0)  # m/s, over the window
    squares: float = 0.0  # m^2/s, of the sums' lengths since they are worth something
    age: float = 0.0  # s

    def update(self, residual: Vector, velocity: Vector, dt: float) -> "Drift":
        """After `dt` (s) with an acceleration (m/s^2, world) that thrust didn't explain."""
        # x and y of the velocity; the third, the height, is left out
        level = list(zip(self.fits, residual, velocity, strict=False))
        decay = math.exp(-dt / WINDOW)
        totals = tuple(
            decay * total + dt * (acceleration - fit.at(speed))
            for total, (fit, acceleration, speed) in zip(self.totals, level, strict=False)
        )
        fits = tuple(fit.update(acceleration, speed, dt) for fit, acceleration, speed in level)
        worth = dt if self.age > LEARNT else 0.0
        squares = self.squares + worth * sum(part**2 for part in totals)
        return Drift(fits, totals, squares, self.age + dt)

    @property
    def size(self) -> float:
        """The size of the sum (m/s)."""
        return math.hypot(*self.totals)

    @property
    def usual(self) -> float:
        """Root mean square of its sums (m/s); infinite before they are worth something."""
        seconds = self.age - LEARNT
        return math.sqrt(self.squares / seconds) if seconds > 1.0 else math.inf


def drifting(drifts: Sequence[Drift]) -> tuple[bool, ...]:
    """For each vehicle, True if its sum is larger than its teammates' are. A lone vehicle has
    nothing to compare with.
    """
    usual = [drift.usual for drift in drifts]
    largest = [max((*usual[:i], *usual[i + 1 :]), default=math.inf) for i in range(len(usual))]
    return tuple(
        drift.age > LEARNT and drift.size > max(FLOOR, RATIO * others)
        for drift, others in zip(drifts, largest, strict=True)
    )
