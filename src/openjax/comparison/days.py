"""Days as a random effect: trims of each day, how far normal days of a vehicle lie apart, and what the battery has in it.

A flight's trims (how hard it had to work to hover, and the roll, pitch and yaw that the mixer added to stay level)
repeat within a day far better than from day to day: batteries, propellers and how the frame was put together
shift them. The spread of days is learnt from the reference's days where it holds several, over a prior; flights of one
folder whose trims are far apart count as several days.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from openjax.comparison.figures import TRIMS, FlightFigures

# Spread (standard deviation) of a vehicle's normal days: for trims 1 to 2.5 % of hover, measured on published flights
# of two Crazyflies; yaw more, because its torque is a hundredth of thrust times arm and a tilted motor shows in it.
DAY_SPREAD = {"hover": 0.012, "roll": 0.02, "pitch": 0.02, "yaw": 0.03}
PRIOR_DAYS = 6.0  # days of experience that this prior is worth
SAME_DAY = 0.012  # of hover: roll and pitch trims further apart were flown on different days
WITHIN_DAY = {"hover": 0.003, "roll": 0.0025, "pitch": 0.0025, "yaw": 0.005}  # repeatability of a flight
VOLTAGE_SLOPE = (0.0, 0.15)  # 1/V of hover, prior mean and standard deviation
VOLTAGE_SPREAD = 0.1  # V, by which flights without a logged voltage may differ


def days_told_apart(figures: Sequence[FlightFigures]) -> list[FlightFigures]:
    """The flights of one folder with their days: those whose roll and pitch trims lie further apart than flights of
    a day ever do count as flown on different days."""
    if len(figures) < 2:
        return list(figures)
    trims = np.array([f.trims()[0][1:3] for f in figures])
    error = max(float(np.median([f.trims()[1][1:3].max() for f in figures])), 1e-9)
    groups = fcluster(linkage(trims, "complete"), max(SAME_DAY, 3.0 * error), "distance")
    return [dataclasses.replace(f, day=f"{f.day}#{g}") for f, g in zip(figures, groups, strict=True)]


@dataclass(frozen=True)
class Days:
    """Trims by day."""

    days: np.ndarray  # (D, 4) logarithm of hover, roll, pitch, yaw
    mean: np.ndarray  # (4,)
    error: np.ndarray  # (4,) of the mean, without the spread of days


@dataclass(frozen=True)
class Battery:
    """How hover follows the voltage."""

    voltage: float  # V, at which hover is compared: the mean of all flights that logged it
    slope: float  # 1/V, of the logarithm of hover
    error: float  # of the slope


def battery_of(figures: Sequence[FlightFigures]) -> Battery:
    """How hover follows the battery's voltage: flights of a day against each other, since neither the day nor a
    change can enter there."""
    mean, sigma = VOLTAGE_SLOPE
    xx, xy, voltages = 0.0, 0.0, []
    for day in {f.day for f in figures}:
        pairs = [
            (f.voltage, np.log(f.values["hover"][0]))
            for f in figures
            if f.day == day and f.voltage is not None
        ]
        if pairs:
            v, h = np.array(pairs).T
            voltages += v.tolist()
            xx += ((v - v.mean()) ** 2).sum()
            xy += ((v - v.mean()) * (h - h.mean())).sum()
    noise = WITHIN_DAY["hover"] ** 2
    precision = xx / noise + 1 / sigma**2
    voltage = float(np.mean(voltages)) if voltages else 0.0
    return Battery(voltage, float((xy / noise + mean / sigma**2) / precision), float(precision**-0.5))


def by_day(figures: Sequence[FlightFigures], battery: Battery) -> Days:
    within = np.array([WITHIN_DAY[n] for n in TRIMS])
    days, variances = [], []
    for day in dict.fromkeys(f.day for f in figures):
        values, errors = [], []
        for flight in (f for f in figures if f.day == day):
            value, error = flight.trims()
            error = error.copy()
            error[0] /= value[0]
            value = np.r_[np.log(value[0]), value[1:]]
            if flight.voltage is None:
                error[0] = np.hypot(error[0], np.hypot(battery.slope, battery.error) * VOLTAGE_SPREAD)
            else:
                value[0] -= battery.slope * (flight.voltage - battery.voltage)
                error[0] = np.hypot(error[0], battery.error * (flight.voltage - battery.voltage))
            values.append(value)
            errors.append(np.hypot(error, within))
        precision = 1 / np.array(errors) ** 2
        days.append((np.array(values) * precision).sum(0) / precision.sum(0))
        variances.append(1 / precision.sum(0))
    return Days(np.array(days), np.mean(days, 0), np.sqrt(np.mean(variances, 0) / len(days)))


def spread_of_days(*sets: Days) -> tuple[np.ndarray, float]:
    """Standard deviation (4,) of normal days and the degrees of freedom behind it: the prior and what the days of each
    set show."""
    freedom, total = PRIOR_DAYS, PRIOR_DAYS * np.array([DAY_SPREAD[n] for n in TRIMS]) ** 2
    for one in sets:
        freedom += len(one.days) - 1
        total = total + ((one.days - one.mean) ** 2).sum(0)
    return np.sqrt(total / freedom), freedom
