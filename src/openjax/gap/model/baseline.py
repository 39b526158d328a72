"""What a vehicle is like while nothing is wrong with it, as its reference flights tell:
the effects that it always has, with one joint normal distribution of their numbers.

In a diagnosis it takes the place of the nominal vehicle: effects start from there, and
what is known together (drag and flapping) stays known together. Nuisances aren't taken
over: what they take depends on what is flown, as in closed loop they also take what
feedback makes of gusts.
"""

from dataclasses import dataclass

import numpy as np

from openjax.gap.decision import DECISION
from openjax.gap.identification.quantities import Identification
from openjax.gap.model.library import CARDS, PHYSICS_EFFECTS
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import growth

# Effects that every vehicle has to some degree: what a simulator gets wrong of it on
# any day. Trims of 1 to 2.5 % of hover were measured over days on published flights of
# two Crazyflies.
FORM = tuple(e for e in PHYSICS_EFFECTS if CARDS[e].days is not None)


@dataclass(frozen=True, eq=False)
class Baseline:
    """`theta` (P,) of the physics; `effects` that act in the reference, of the
    vehicle's form; `names` of their numbers ("effect parameter") whose joint
    `covariance` is known; `measures` of what is left of the reference flights, as
    `residual` has them; `channels` of the reference by path; `trim` (4,) of its rotors
    on that day, as `reference.trim_of`; `identification`: how its torques answered.
    """

    theta: np.ndarray
    effects: tuple[str, ...]
    names: tuple[str, ...]
    covariance: np.ndarray
    measures: dict[str, float]
    channels: dict[str, object]
    trim: np.ndarray
    identification: Identification | None = None

    @property
    def numbers(self) -> tuple[tuple[str, str, float], ...]:
        """The knowledge of the vehicle, as `library.numbers_of` has it, in units of the
        parameter.
        """
        return tuple((*name.split(" "), 1.0) for name in self.names)

    def mixing(self, names) -> np.ndarray:
        """(N, N): columns of `names`, each of its usual size or unit -> columns of unit
        prior variance.
        """
        out = np.eye(len(names))
        rows = [k for k, n in enumerate(names) if n in self.names]
        columns = [self.names.index(names[k]) for k in rows]
        block = self.covariance[np.ix_(columns, columns)]
        out[np.ix_(rows, rows)] = np.linalg.cholesky(block).T
        return out


def day_of(effect: str, parameter: str, vehicle, silent: bool) -> float:
    """Standard deviation over days of a number; `silent`: motors are duty cycles whose
    battery nobody logged.
    """
    card = CARDS[effect]
    entry = next(p for p in card.fitted if p.name == parameter)
    usual = entry.nuisance.size("always", vehicle) or 0.0
    spread = np.hypot(entry.spread, card.common * (not entry.coupling))
    spread *= growth(EFFECTS[effect].parameters[parameter].unit, vehicle)
    charge = entry.nuisance.duty_cycles if silent and "thrust_map" in card.needs else None
    return max(
        charge or 0.0,
        card.days or 0.0,
        DECISION.day_share * usual,
        DECISION.form_error * float(spread),
    )


def transfer(
    hessian: np.ndarray, push: np.ndarray, prior: np.ndarray, of_a_day: np.ndarray, days: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance, on another day, of the numbers that are not `of_a_day` (N,).

    The reference's flights are a measurement of information `hessian` (N, N) and right
    side `push` (N,), beside what such vehicles usually are: precision `prior` (N, N)
    around 0. What is of a day is marginalised. Of the rest each number moves between
    two days by `days` (N,), so a measurement of one day tells less of another. What the
    flights don't show stays as it usually is.
    """
    day_rows, rest = np.flatnonzero(of_a_day), np.flatnonzero(~of_a_day)
    inside = hessian[np.ix_(day_rows, day_rows)] + prior[np.ix_(day_rows, day_rows)]
    solution = np.linalg.solve(
        inside, np.column_stack([hessian[np.ix_(day_rows, rest)], push[day_rows]])
    )
    data = hessian[np.ix_(rest, rest)] - hessian[np.ix_(rest, day_rows)] @ solution[:, :-1]
    right = push[rest] - hessian[np.ix_(rest, day_rows)] @ solution[:, -1]
    # (I + D S) of information D
    gain = np.eye(len(rest)) + data * np.square(days[rest])
    data, right = np.linalg.solve(gain, data), np.linalg.solve(gain, right)
    covariance = np.linalg.inv(0.5 * (data + data.T) + prior[np.ix_(rest, rest)])
    return covariance @ right, covariance


def with_days(usual, vehicle) -> tuple[tuple[str, str, float], ...]:
    """The numbers of `library.numbers_of`, with what a day moves of each: how a vehicle
    is on the day of its reference.
    """
    sizes = {(e, p): size for e, p, size in usual}
    for effect in (e for e in FORM if CARDS[e].days):
        for p in CARDS[effect].fitted:
            key = effect, p.name
            sizes[key] = float(np.hypot(sizes.get(key, 0.0), CARDS[effect].days))
    return tuple((*key, size) for key, size in sizes.items())
