"""Reports made by hand, of all kinds: what is named, measured and seen in trims."""

from types import SimpleNamespace

import numpy as np

from openjax.gap.identification.quantities import KINDS, Identification, Quantity
from openjax.gap.identification.responses import FREQUENCIES, Pair, Response
from openjax.gap.model.library import CARDS
from openjax.gap.report import Estimate, Report
from openjax.gap.shares import Gap, Share, Split
from openjax.gap.trims import change_between
from openjax.gap.trims.figures import FlightFigures, mixer_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()
CASE = SimpleNamespace(
    vehicle_of=lambda flight: VEHICLE,
    flights=[None],
    vehicle_file=SimpleNamespace(motor_permutation=(0, 1, 2, 3)),
)


def flights_of(day, factors=(1.0, 1.0, 1.0, 1.0)):
    """Trims of three flights of a vehicle whose rotors need these factors."""
    rng = np.random.default_rng(len(day))
    mixed = mixer_of(VEHICLE) @ np.asarray(factors)
    out = []
    for number in range(3):
        values = np.r_[0.6 * mixed[0], mixed[1:] / mixed[0]] + 0.001 * rng.standard_normal(4)
        named = zip(("hover", "roll", "pitch", "yaw"), values, strict=True)
        figures = {name: (float(value), 0.001) for name, value in named}
        out.append(FlightFigures(f"{day}{number}", day, figures, None))
    return out


OLD = [flight for day in ("monday", "friday") for flight in flights_of(day)]


def change(rise, rotors=(2,)):
    """What trims say of rotors that need so much more."""
    factors = [1.0 + rise * (rotor in rotors) for rotor in range(4)]
    return change_between("tuesday", flights_of("new", factors), OLD, CASE)


def identification(ratio=1.0, error=0.03, lag=0.025, lag_error=0.1, trusted=True):
    """Torques that are so many times the simulator's, and motors of so many seconds;
    errors are half widths of logarithms at 90 %.
    """

    def response(axis, gain, width):
        band = tuple((gain * np.exp([-width, 0.0, width])).tolist())
        count = len(FREQUENCIES)
        return Response(
            axis, tuple(FREQUENCIES.tolist()), (band,) * count, ((-2.0, 0.0, 2.0),) * count
        )

    pairs = {
        axis: Pair(response(axis, 100.0 * ratio, error), response(axis, 100.0, 0.5 * error))
        for axis in ("roll", "pitch")
    }
    low, high = (lag * np.exp(sign * lag_error) for sign in (-1.0, 1.0))
    quantities = {
        "spin_up": Quantity(lag, (low, high), 0.025, "s", KINDS["spin_up"].effect),
        "yaw_trim": Quantity(0.01, (-0.01, 0.03), 0.0, "1", KINDS["yaw_trim"].effect),
    }
    deviation = lag_error / 1.645 * lag
    estimates = SimpleNamespace(
        names=(("motor_lag", "extra_up"),),
        value=np.array([lag - 0.025]),
        covariance=np.array([[deviation**2]]),
    )
    remarks = () if trusted else ("the vehicle hardly turns; fly the segments yaw or step",)
    return Identification(quantities, pairs, remarks, estimates, trusted)


def report(effects=(), verdict="none", before=1.0, after=1.0, **more):
    """A report with shares of .7 for the first effect and .2 for others."""
    named = [e for e in effects if e != "unknown"]
    found = {e: Share(0.2 if i else 0.7, (0.1, 0.8)) for i, e in enumerate(named)}
    rest = 1.0 - sum(share.value for share in found.values())
    reduction = 1.0 - after / before
    gap = Gap("rms", before, after, 1.0, reduction, (reduction - 0.05, reduction + 0.05))
    shares = Split(gap, found, Share(rest, (0.0, 1.0)), Share(0.0, (0.0, 0.1)), {})
    sizes = {
        e: {
            p.name: Estimate(p.start, "1", (0.8 * p.start, 1.2 * p.start), (0.0, 2.0 * p.start))
            for p in CARDS[e].fitted[:1]
        }
        for e in named
    }
    others = {"none": 0.05, "unknown": 0.02} | dict.fromkeys(named, 0.4)
    if not named:
        others = {"none": 0.9, "unknown": 0.05} | (
            {"unknown": 0.95, "none": 0.02} if effects else {}
        )
    filled = {
        "probabilities": others, "equivalent": {}, "where": [], "not_testable": ["downwash"],
        "quality": [], "parameters": sizes,
    } | more  # fmt: skip
    return Report("tuesday", verdict, tuple(effects), shares=shares, gap=gap, **filled)
