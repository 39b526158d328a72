"""What is local in time: pushes that come and go quicker than turbulence.

The rest's sideways specific force is that of air and of strangers alone: no motor makes it, the accelerometer's noise is
its own, and turbulence changes it slowly. Its changes within a tenth of a second are then as a normal distribution has
them. Knocks, jets that switch and ropes that tauten are rare and large: their fourth moment tells. Vertical force,
torques and velocities don't serve: late clocks, single samples of motors and interpolated poses are as uneven."""

from __future__ import annotations

import numpy as np

from openjax.flights.track import Track
from openjax.gap.replay import FORCE, SKIP

WIDTHS = (0.05, 0.1)  # s of the means whose differences are looked at
CLEAR = 5.5  # standard errors of the kurtosis of as many normal numbers
LEAST = 1.0  # of the kurtosis above three: below, it is a matter of how steady turbulence was
PUSH = 0.1  # m/s^2, a hundredth of the weight: the largest must be more to matter


def knocks(tracks: list[Track], disturbed: list[np.ndarray], usable: np.ndarray) -> tuple[str, ...]:
    """Findings in words. disturbed [(T, 9)]: what is left as accelerations, see `rest.disturbances`; usable (9,)."""
    if usable[FORCE][:2].min() <= 0.0:
        return ()
    for width in WIDTHS:
        changes = [
            _changes(d[int(SKIP / t.dt) :, FORCE][:, :2], width, t.dt)
            for t, d in zip(tracks, disturbed, strict=True)
        ]
        changes = np.concatenate(changes)
        number = changes.size * min(t.dt for t in tracks) / (2.0 * width)  # that share no sample
        if number < 100:
            continue
        # Axes differ in what acts along them, and flights in their air.
        kurtosis = float(np.mean((changes / np.sqrt(np.mean(changes**2, 0) + 1e-30)) ** 4))
        size = float(np.sqrt((changes**2).sum(1).max()))
        if size > PUSH and kurtosis > 3.0 + max(LEAST, CLEAR * np.sqrt(24.0 / number)):
            return (
                f"sudden pushes to the side, up to {size:.1f} m/s^2 within {width:g} s (kurtosis {kurtosis:.1f})",
            )
    return ()


def _changes(values: np.ndarray, width: float, dt: float) -> np.ndarray:
    """Differences (N, 2) between means over `width` s and those over the next `width` s."""
    rows = max(round(width / dt), 1)
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(values, 0)])
    means = (total[rows:] - total[:-rows]) / rows
    return means[rows:] - means[:-rows]
