"""The fit of each effect of `openjax.vehicle.effects`: which parameters, where to
start, what is plausible.

Priors are weak: their spread is of the order of the effect's usual range.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from openjax.errors import UserError, suggestion
from openjax.gap.model.blocks import block_diagonal
from openjax.gap.shapes import Parameters
from openjax.vehicle.effects import EFFECTS, Card
from openjax.vehicle.effects.effect import Situation, growth

# {effect: its card}: what can be diagnosed.
CARDS: dict[str, Card] = {
    name: effect.card for name, effect in EFFECTS.items() if effect.card is not None
}


def shipped_card(path: str) -> Card:
    """The card of the one shipped effect of a path beside the physics: the first, as a user's own
    effects are registered after it.
    """
    return next(card for card in CARDS.values() if card.path == path)


def numbers_of(situation: Situation, vehicle) -> tuple[tuple[str, str, float], ...]:
    """(effect, parameter, usual size) of small errors of a vehicle's numbers, which are
    free in every hypothesis.
    """
    return tuple(
        (e, p.name, size)
        for e, card in CARDS.items()
        for p in card.fitted
        if (size := p.nuisance.size(situation, vehicle)) is not None
    )


BALANCE = 0.9999  # share of the common variance that `balanced` parameters go without


@dataclass(frozen=True)
class Library:
    """The effects that may be named, in one order, and the vector of all physics
    parameters.
    """

    effects: tuple[str, ...] = tuple(EFFECTS)

    @cached_property
    def physics(self) -> tuple[str, ...]:
        """Effects that act between the motors and the motion."""
        return self.of("physics")

    def of(self, path: str) -> tuple[str, ...]:
        """Effects that are read by one path of the log."""
        return tuple(e for e in self.effects if path_of(e) == path)


# Every physics parameter has a fixed place in theta, whatever is left out of a library:
# one compiled function. The last two are no effect's: the propellers' inertia and the
# motors' shift in time, see `physics`.
PHYSICS_EFFECTS = tuple(e for e in CARDS if CARDS[e].path == "physics")
THETA = tuple((e, p.name) for e in PHYSICS_EFFECTS for p in CARDS[e].fitted)
PLACE = {key: number for number, key in enumerate(THETA)}
ABSENT = np.array([EFFECTS[e].parameters[p].none for e, p in THETA] + [0.0, 0.0])
STEP = np.array([p.step for e in PHYSICS_EFFECTS for p in CARDS[e].fitted] + [1e-3, 2e-4])


def path_of(effect: str) -> str:
    """By which path of the log an effect is read: see `Card`."""
    return CARDS[effect].path


def library(without=()) -> Library:
    """All effects but those in `without`. Raises UserError for unknown names."""
    for name in without:
        if name not in EFFECTS:
            raise UserError(f"--without {name}: no such effect; {suggestion(name, EFFECTS)}")
    return Library(tuple(e for e in EFFECTS if e in CARDS and e not in without))


def places(effects) -> Int[np.ndarray, " own"]:
    """Indices in theta of the own parameters of physics effects."""
    return np.array([PLACE[e, p.name] for e in effects for p in CARDS[e].fitted], int)


def growths(vehicle) -> Parameters:
    """(P,) by what usual sizes of the parameters are multiplied for a vehicle of
    another size.
    """
    factors = [growth(EFFECTS[e].parameters[p].unit, vehicle) for e, p in THETA]
    return np.array([*factors, 1.0, 1.0])


def absent_beside(effects, absent: Parameters) -> Parameters:
    """(P,) a vehicle that has `absent` while nothing acts, as far as none of these
    `effects` takes its place.
    """
    out = absent.copy()
    for effect in effects:
        card = CARDS[effect]
        if card.takes_over is None:
            continue
        other, numbers_of_it = card.takes_over
        at = places((other,))
        if (absent[at] != ABSENT[at]).any():
            out[at] = ABSENT[at]
            values = {p.name: float(absent[PLACE[other, p.name]]) for p in CARDS[other].fitted}
            usual = {p.name: p.mean for p in card.fitted}
            for name, value in numbers_of_it(values).items():
                out[PLACE[effect, name]] += value - usual[name]
    return out


def prior(
    effects, absent: Parameters = ABSENT, size_factors: Parameters | None = None, other_sizes=None
) -> tuple[Int[np.ndarray, " own"], Float[np.ndarray, " own"], Float[np.ndarray, "own own"]]:
    """Indices (p,), mean (p,) and precision (p, p) of the parameters of a set of
    physics effects, for a vehicle that has `absent` (P,) while nothing acts and sizes
    that are `size_factors` (P,). `other_sizes` {effect: (mean, covariance)}: by other
    estimators.
    """
    index = []
    means = []
    blocks = []
    absent = absent_beside(effects, absent)
    for effect in effects:
        card = CARDS[effect]
        at = places((effect,))
        index += at.tolist()
        if other_sizes and effect in other_sizes:
            mean, covariance = other_sizes[effect]
        else:
            size = np.ones(len(at)) if size_factors is None else size_factors[at]
            mean = size * np.array([p.mean for p in card.fitted]) + (absent - ABSENT)[at]
            covariance = _usual_covariance(card) * np.outer(size, size)
        means.append(mean)
        blocks.append(np.linalg.inv(covariance))
    return np.array(index, int), np.concatenate([np.zeros(0), *means]), block_diagonal(blocks)


def forbidden(theta: np.ndarray, effects: Iterable[str], vehicle) -> set[str]:
    """Those of the motion's `effects` that do nothing once their parameters, as in theta
    (P,), are brought to where physics allows them: drag that pushes, a battery that makes
    more thrust the emptier it is.
    """

    def acts(effect: str) -> bool:
        for entry in CARDS[effect].fitted:
            parameter = EFFECTS[effect].parameters[entry.name]
            least, most = parameter.limits(vehicle)
            value = np.clip(theta[PLACE[effect, entry.name]], least, most)
            if not entry.shape and value != parameter.none:
                return True
        return False

    return {effect for effect in effects if not acts(effect)}


def _usual_covariance(card: Card) -> np.ndarray:
    """(p, p) of an effect's parameters, as its card says."""
    common = [card.common * (not p.coupling) for p in card.fitted]
    block = np.diag([p.spread**2 for p in card.fitted]) + np.outer(common, common)
    return block - BALANCE * block.mean() if card.balanced else block
