"""How each effect of `openjax.vehicle.effects` is fitted: which parameters, where to start, what is
plausible.

Priors are weak: their spread is of the order of the effect's usual range. A *companion* is a parameter of
another effect that may move a little whenever this one does, because real effects seldom have exactly the
library's form (a payload adds inertia, drag acts above the centre of mass)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.errors import UserError
from openjax.vehicle.effects import EFFECTS, Card

# {effect: its card}: what can be diagnosed.
CARDS: dict[str, Card] = {name: effect.card for name, effect in EFFECTS.items() if effect.card is not None}

# Small errors of the vehicle's numbers that no effect is blamed for - a thrust off by less than a per cent - and what the
# replay's own step and the half-known motor commands inside a row leave: some per cent of a torque, a millisecond.
NUISANCES = (
    ("thrust_scale", "scale", 0.004),
    ("inertia", "xx", 0.04),
    ("inertia", "yy", 0.04),
    ("inertia", "zz", 0.015),
    ("motor_lag", "extra_up", 0.0015),
    ("motor_lag", "extra_down", 0.0015),
    ("yaw_torque", "ratio", 0.01),
)
# With duty cycles for motor commands the map to thrust is a guess: scale, shape, lag and torques are free, and what they
# can imitate isn't testable.
PWM_NUISANCES = (
    ("thrust_scale", "scale", 0.3),
    ("inertia", "xx", 0.2),
    ("inertia", "yy", 0.2),
    ("inertia", "zz", 0.2),
    ("motor_lag", "extra_up", 0.01),
    ("motor_lag", "extra_down", 0.01),
    ("thrust_curve", "offset", 0.15),
    ("thrust_curve", "curvature", 0.3),
    ("yaw_torque", "ratio", 0.5),
)
# With single samples of the motors and no way to tell what they did between them, kicks at the rows' beginnings make
# them look stronger than they are, and up to two rows earlier.
SAMPLED_NUISANCES = (
    ("thrust_scale", "scale", 0.004),
    ("inertia", "xx", 0.3),
    ("inertia", "yy", 0.3),
    ("inertia", "zz", 0.3),
    ("motor_lag", "extra_up", 0.01),
    ("motor_lag", "extra_down", 0.01),
    ("yaw_torque", "ratio", 0.2),
)
# By how much more these may seem wrong, per share of gusts in the torques (`feedback.gustiness`), about which axes:
# commands answer gusts by way of the attitude, so that in closed loop motors look weak and early.
GUSTY = {
    ("inertia", "xx"): (1.0, (0,)),
    ("inertia", "yy"): (1.0, (1,)),
    ("inertia", "zz"): (0.3, (2,)),
    ("motor_lag", "extra_up"): (0.01, (0, 1)),
    ("motor_lag", "extra_down"): (0.01, (0, 1)),
}
BALANCE = 0.9999  # share of the common variance that `balanced` parameters go without
MOTOR_SHIFT = 0.001  # s, standard deviation of the motors' clock offset


@dataclass(frozen=True)
class Library:
    """The effects that may be named, in one order, and the vector of all physics parameters."""

    effects: tuple[str, ...] = tuple(EFFECTS)

    @cached_property
    def physics(self) -> tuple[str, ...]:
        """Effects that act between the motors and the motion."""
        return tuple(e for e in self.effects if path_of(e) == "physics")


# Every physics parameter has a fixed place in theta, whatever is left out of a library: one compiled
# function.
PHYSICS_EFFECTS = tuple(e for e in CARDS if CARDS[e].path == "physics")
THETA = tuple((e, p.name) for e in PHYSICS_EFFECTS for p in CARDS[e].fitted)
PLACE = {key: number for number, key in enumerate(THETA)}
ABSENT = np.array([EFFECTS[e].parameters[p].none for e, p in THETA] + [0.0])
STEP = np.array([p.step for e in PHYSICS_EFFECTS for p in CARDS[e].fitted] + [2e-4])


def path_of(effect: str) -> str:
    """By which path of the log an effect is read: see `Card`."""
    return CARDS[effect].path


def library(without=()) -> Library:
    """All effects but those in `without`. Raises UserError for unknown names."""
    for name in without:
        if name not in EFFECTS:
            raise UserError(f"--without {name}: no such effect; known: {', '.join(EFFECTS)}")
    return Library(tuple(e for e in EFFECTS if e in CARDS and e not in without))


def places(effects) -> np.ndarray:
    """Indices in theta of the own parameters of physics effects."""
    return np.array([PLACE[e, p.name] for e in effects for p in CARDS[e].fitted], int)


def start_of(effect: str, number: int = 0) -> np.ndarray:
    """A start of the search: the first, or one of the `others`."""
    card = CARDS[effect]
    return np.array([p.start for p in card.fitted]) if number == 0 else np.array(card.others[number - 1])


def prior(effects) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (p,), mean (p,) and precision (p, p) of the parameters of a set of physics effects,
    companions last."""
    index, mean, blocks = [], [], []
    for effect in effects:
        card = CARDS[effect]
        index += [PLACE[effect, p.name] for p in card.fitted]
        mean += [p.mean for p in card.fitted]
        block = np.diag([p.spread**2 for p in card.fitted]) + card.common**2
        blocks.append(block - BALANCE * block.mean() if card.balanced else block)
    for effect in effects:
        for other, parameter, spread in CARDS[effect].companions:
            if PLACE[other, parameter] not in index:
                index.append(PLACE[other, parameter])
                mean.append(ABSENT[index[-1]])
                blocks.append(np.array([[spread**2]]))
    size = len(index)
    covariance, at = np.zeros((size, size)), 0
    for block in blocks:
        covariance[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    precision = np.linalg.inv(covariance) if size else covariance
    return np.array(index, int), np.array(mean), precision
