"""What is compared besides the trims: drag, lag, torque and noise, each a day's spread or a change of its usual size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm

from openjax.comparison.days import PRIOR_DAYS
from openjax.comparison.figures import FlightFigures
from openjax.comparison.result import Interval, OtherFigure

# What is cut, bent or taped on also shakes: the noise of gyroscope and motors rises by some 40 % or more, though air
# and battery move it as well. So it may support a change of the trims, within bounds, never start one.
SHAKES = (0.4, 0.4)  # mean and standard deviation of the logarithm's change
SUPPORT = 3.0  # largest factor on the odds

# Other figures: unit, spread of normal days, usual size of a change.
OTHERS = {
    "drag_x": ("1/s", 0.04, 0.3),
    "drag_y": ("1/s", 0.04, 0.3),
    "lag": ("s", 0.005, 0.03),
    "torque_gain": ("", 0.07, 0.3),
    "gyroscope_noise": ("", 0.35, 1.0),
    "accelerometer_noise": ("", 0.35, 1.0),
    "motor_noise": ("", 0.35, 1.0),
}
OTHER_CHANGED = 0.1  # prior probability of each of them


def support_of(others: Sequence[OtherFigure]) -> float:
    """Factor on the odds of a change from the noise of gyroscope and motors."""
    noise = [o for o in others if o.name in ("gyroscope_noise", "motor_noise")]
    if not noise:
        return 1.0
    rise = np.mean([o.difference.value for o in noise])
    spread = np.mean([(o.difference.high - o.difference.low) / 3.29 for o in noise])
    logs = norm.logpdf(rise, SHAKES[0], np.hypot(spread, SHAKES[1])) - norm.logpdf(rise, 0.0, spread)
    return float(np.clip(np.exp(logs), 1 / SUPPORT, SUPPORT))


def compare_others(new: Sequence[FlightFigures], old: Sequence[FlightFigures]) -> tuple[OtherFigure, ...]:
    """Drag, lag, torque and noise: each a day's spread or a change of the usual size."""
    out = []
    for name, (unit, day_spread, usual) in OTHERS.items():
        sets = []
        for figures in (old, new):
            days = []
            for day in dict.fromkeys(f.day for f in figures):
                own = [f.values[name] for f in figures if f.day == day and name in f.values]
                if own:
                    value, error = np.array(own).T
                    days.append(
                        (
                            value.mean(),
                            np.hypot(error.mean() / np.sqrt(len(own)), value.std() / len(own) ** 0.5),
                        )
                    )
            sets.append(days)
        if not all(sets):
            continue
        means = [np.mean([d[0] for d in days]) for days in sets]
        freedom = PRIOR_DAYS + sum(len(days) - 1 for days in sets)
        total = PRIOR_DAYS * day_spread**2 + sum(np.var([d[0] for d in days]) * len(days) for days in sets)
        variance = sum(
            total / freedom / len(days) + np.mean([d[1] ** 2 for d in days]) / len(days) for days in sets
        )
        difference = means[1] - means[0]
        # A change of the usual size widens the same distribution.
        logs = [
            -0.5 * np.log(v) - 0.5 * (freedom + 1) * np.log1p(difference**2 / v / freedom)
            for v in (variance, variance + usual**2)
        ]
        odds = OTHER_CHANGED / (1 - OTHER_CHANGED) * np.exp(logs[1] - logs[0])
        reach = 1.645 * np.sqrt(variance)
        out.append(OtherFigure(name, unit, Interval(float(difference), float(difference - reach),
                                                    float(difference + reach)), float(odds / (1 + odds))))  # fmt: skip
    return tuple(out)
