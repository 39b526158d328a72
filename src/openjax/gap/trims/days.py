"""Days as a random effect: figures of each day, how far normal days of a vehicle lie
apart, and what the battery has in it.

A flight's trims (how hard it had to work to hover, and the roll, pitch and yaw that the
mixer added to stay level) repeat within a day far better than from day to day:
batteries, propellers and how the frame was put together shift them. The spread of days
is learnt from the reference's days where it holds several, over a prior; flights of one
folder whose trims are far apart count as several days.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from openjax.gap.decision import DECISION
from openjax.gap.trims.figures import FIGURES, PLACES, FlightFigures

DAY_SPREAD, WITHIN_DAY = np.array([(figure.day, figure.within) for figure in FIGURES.values()]).T
HOVER = PLACES["hover"]
# 1/V of hover, prior mean and standard deviation: thrust commands are what the
# firmware's battery compensation makes of them, and duty cycles with their voltage are
# turned into thrust by its map.
VOLTAGE_SLOPE = (0.0, 0.05)
# By what the logarithm of thrust per duty cycle differs between two days whose voltage
# isn't known: the map's 1.4 times that of the voltage at hover, of batteries of 3.4 to
# 4.1 V under load.
CHARGE = 1.4 * 0.2 / 3.7
VOLTAGE_SPREAD = 0.1  # V, by which flights without a logged voltage may differ


def days_told_apart(figures: Sequence[FlightFigures]) -> list[FlightFigures]:
    """The flights of one folder with their days: those whose roll and pitch trims lie
    further apart than flights of a day ever do count as flown on different days.
    """
    if len(figures) < 2:
        return list(figures)
    trims = np.array([f.all()[0][1:3] for f in figures])
    error = max(float(np.median([f.all()[1][1:3].max() for f in figures])), 1e-9)
    apart = max(DECISION.same_day, DECISION.clear_errors * error)
    groups = fcluster(linkage(trims, "complete"), apart, "distance")
    return [
        dataclasses.replace(f, day=f"{f.day}#{g}") for f, g in zip(figures, groups, strict=True)
    ]


@dataclass(frozen=True)
class Days:
    """Figures by day, hover as its logarithm; NaN where no flight of the day gives
    one.
    """

    days: np.ndarray  # (D, F)
    mean: np.ndarray  # (F,)
    error: np.ndarray  # (F,) of the mean, without the spread of days

    @property
    def count(self) -> np.ndarray:
        """Days (F,) that give a figure."""
        return np.isfinite(self.days).sum(0)


@dataclass(frozen=True)
class Battery:
    """Dependence of hover on the voltage."""

    # V, at which hover is compared: the mean of all flights that logged it
    voltage: float
    slope: float  # 1/V, of the logarithm of hover
    error: float  # of the slope


def battery_of(figures: Sequence[FlightFigures]) -> Battery:
    """Dependence of hover on the battery's voltage: flights of a day against each other,
    since neither the day nor a change can enter there.
    """
    mean, sigma = VOLTAGE_SLOPE
    xx = 0.0
    xy = 0.0
    voltages = []
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
    noise = WITHIN_DAY[HOVER] ** 2
    precision = xx / noise + 1 / sigma**2
    voltage = float(np.mean(voltages)) if voltages else 0.0
    return Battery(
        voltage, float((xy / noise + mean / sigma**2) / precision), float(precision**-0.5)
    )


def by_day(figures: Sequence[FlightFigures], battery: Battery) -> Days:
    """Means of each day's flights, weighted by their errors, at the voltage of
    `battery`.
    """
    days = []
    variances = []
    for day in dict.fromkeys(f.day for f in figures):
        each = [_at_voltage(f, battery) for f in figures if f.day == day]
        values, errors = (np.array(part) for part in zip(*each, strict=True))
        precision = np.where(np.isfinite(values), 1 / (errors**2 + WITHIN_DAY**2), 0.0)
        total = precision.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            days.append((np.nan_to_num(values) * precision).sum(0) / total)
            variances.append(np.where(total > 0, 1 / total, np.nan))
    days = np.array(days)
    variances = np.array(variances)
    count = np.maximum(np.isfinite(days).sum(0), 1)
    mean = np.where(np.isfinite(days).any(0), np.nansum(days, 0) / count, np.nan)
    return Days(days, mean, np.sqrt(np.nansum(variances, 0)) / count)


def _at_voltage(flight: FlightFigures, battery: Battery) -> tuple[np.ndarray, np.ndarray]:
    """Figures and errors (F,), the logarithm of hover at the battery's voltage."""
    value, error = (part.copy() for part in flight.all())
    error[HOVER] /= value[HOVER]
    value[HOVER] = np.log(value[HOVER])
    if flight.voltage is None:
        unsure = np.hypot(battery.slope, battery.error) * VOLTAGE_SPREAD
    else:
        value[HOVER] -= battery.slope * (flight.voltage - battery.voltage)
        unsure = battery.error * (flight.voltage - battery.voltage)
    error[HOVER] = np.hypot(error[HOVER], unsure)
    return value, error


def spread_of_charge(figures: Sequence[FlightFigures]) -> np.ndarray:
    """Standard deviation (F,) of the difference of two days that a battery's unknown
    charge makes: of duty cycles without a voltage.
    """
    silent = any(f.duty and f.voltage is None for f in figures)
    out = np.zeros(len(FIGURES))
    out[HOVER] = 2**0.5 * CHARGE * silent
    return out


def spread_of_days(*sets: Days) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation (F,) of normal days and the degrees of freedom (F,) behind it:
    the prior and what the days of each set show.
    """
    freedom = np.full(len(FIGURES), DECISION.prior_days)
    total = DECISION.prior_days * DAY_SPREAD**2
    for one in sets:
        freedom = freedom + np.maximum(one.count - 1, 0)
        total = total + np.nansum((one.days - one.mean) ** 2, 0)
    return np.sqrt(total / freedom), freedom


def error_of(old: Days, new: Days, spread: np.ndarray, charge: np.ndarray) -> np.ndarray:
    """Standard deviation (F,) of the difference of two sets' means: of their days, of
    their flights, and of the battery's `charge`.
    """
    days = 1 / np.maximum(old.count, 1) + 1 / np.maximum(new.count, 1)
    return np.sqrt(spread**2 * days + old.error**2 + new.error**2 + charge**2)
