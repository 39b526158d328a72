"""What a vehicle is like while nothing is wrong with it, as its reference flights tell: one joint
normal distribution of the numbers that every vehicle has and of the nuisances that the case's
flights share.

In a diagnosis it takes the place of the nominal vehicle: effects start from there, and what is
known together (a lag and a delay, drag and flapping) stays known together.
"""

from dataclasses import dataclass

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.model.library import CARDS, PHYSICS_EFFECTS, PLACE, THETA
from openjax.gap.model.table import Model, Table
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import growth

# Effects that every vehicle has to some degree: what a simulator gets wrong of it on any day. Trims
# of 1 to 2.5 % of hover were measured over days on published flights of two Crazyflies.
FORM = tuple(e for e in PHYSICS_EFFECTS if CARDS[e].days is not None)
NUISANCE_DAYS = 0.3  # of a nuisance's usual size: markers and chips are mounted once
# Of a number's usual spread, by which two sets of flights of one vehicle tell it differently: the
# size by which an effect's form may be wrong (`decision.toml`), and half of what the number is
# usually off by.
FORM_DAYS = 0.5
# Nuisances that a log has of its own.
OF_A_DAY = ("trim", "motors within", "clock", "accelerometer bias")
# Data that a nat is worth less than by white residuals: the median share of their variance that is
# white was .38 over 650 pairs of sets.
COLOURED = 2.6


@dataclass(frozen=True, eq=False)
class Baseline:
    """`theta` (P,) of the physics; `names` of the numbers ("effect parameter") and shared
    nuisances whose joint `covariance` is known, in their units and usual sizes; `mean` of the
    nuisances {name: usual sizes}; `measures` of what is left of the reference flights, as
    `residual` has them; `channels` of the reference by path.
    """

    theta: np.ndarray
    names: tuple[str, ...]
    covariance: np.ndarray
    mean: dict[str, float]
    measures: dict[str, float]
    channels: dict[str, object]

    @property
    def numbers(self) -> tuple[tuple[str, str, float], ...]:
        """Those of the vehicle, as `library.numbers_of` has them, in units of the parameter."""
        inside = set(self.names)
        return tuple((e, p, 1.0) for e, p in THETA if f"{e} {p}" in inside)

    def mixing(self, names) -> np.ndarray:
        """(N, N): columns of `names`, each of its usual size or unit -> columns of unit prior
        variance. What the reference doesn't know stays as usual.
        """
        out = np.eye(len(names))
        rows = [k for k, n in enumerate(names) if n in self.names]
        known = [self.names.index(names[k]) for k in rows]
        block = self.covariance[np.ix_(known, known)]
        out[np.ix_(rows, rows)] = np.linalg.cholesky(block).T
        return out


def day_of(effect: str, parameter: str, vehicle, silent: bool) -> float:
    """Standard deviation over days of a number; `silent`: motors are duty cycles whose battery
    nobody logged.
    """
    card = CARDS[effect]
    usual = card.nuisance.get(parameter, 0.0)
    usual = float(usual(vehicle) if callable(usual) else usual)
    spread = np.hypot(next(p.spread for p in card.fitted if p.name == parameter), card.common)
    spread *= growth(EFFECTS[effect].parameters[parameter].unit, vehicle)
    charge = card.nuisance_duty.get(parameter, 0.0) if silent and card.thrust_map else 0.0
    return max(charge, card.days or 0.0, FORM_DAYS * usual, DECISION.form_error * float(spread))


def joint(table: Table, model: Model, names, day) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Mean and covariance of the numbers of the table's set and of the nuisances `names` (N,) that
    are shared, and what they are called. `day(effect, parameter)`: the spread of a number over days.
    """
    from openjax.gap.model.cross_validation import Equations

    equations = Equations(table, model)
    hessian, _, found = equations.solve(table.total)
    inside = [f"{e} {p}" for e, p in (THETA[i] for i in table.fit.index)]
    called = (*inside, *names)
    days = [day(*n.split(" ")) if n in inside else NUISANCE_DAYS for n in called]
    kept = [k for k, n in enumerate(called) if not n.startswith(OF_A_DAY)]
    covariance = COLOURED * np.linalg.inv(hessian) + np.diag(np.square(days))
    return found, covariance[np.ix_(kept, kept)], tuple(called[k] for k in kept)


def moved(theta: np.ndarray, names, found) -> np.ndarray:
    """theta (P,) with what was found of its numbers."""
    out = theta.copy()
    for name, value in zip(names, found, strict=False):
        key = tuple(name.split(" "))
        if key in PLACE:
            out[PLACE[key]] += value
    return out
