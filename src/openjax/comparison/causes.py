"""What a cause would do to the trims: draws of its size, its place and how well real changes follow its pattern.

    one rotor weaker by a share e     hover, roll, pitch and yaw move alike, signs by the rotor's place and spin
    two rotors weaker                 the sum of two such
    a weight beside a rotor or side   hover, roll and pitch, no yaw
    the whole vehicle                 hover alone (mass, propellers, thrust)
    something else                    no pattern

A rotor that is weaker by e at the same command is given 1 / (1 - e) of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

CAUSES = {
    "one rotor weaker": 0.3,
    "two rotors weaker": 0.3,
    "weight": 0.2,
    "whole vehicle": 0.1,
    "something else": 0.1,
}
USUAL_CHANGE = 0.15  # of a rotor's command, or of the weight
STRONGER = 0.15  # share of changes the other way: a mended rotor, a weight taken off
INEXACT = 0.25  # of each trim of a cause: real changes don't follow their pattern exactly
LEAST_PARTNER = 0.25  # a second rotor that changed by less than this share of the first isn't one
DRAWS = 2048  # of a cause's size and pattern

ROTOR_PLACES = ("front right", "rear right", "rear left", "front left")
SIDES = {
    (0, 1): "right",
    (1, 2): "rear",
    (2, 3): "left",
    (0, 3): "front",
    (0, 2): "diagonal",
    (1, 3): "diagonal",
}
EVERYWHERE = (0, 1, 2, 3)


@dataclass(frozen=True)
class Hypotheses:
    """Draws from all causes: change of the trims (N, 4), prior weight, cause, place and size of each."""

    change: np.ndarray
    weight: np.ndarray
    cause: np.ndarray  # (N,) index into CAUSES
    place: np.ndarray  # (N,) index into `places`
    size: np.ndarray
    places: tuple[tuple[int, ...], ...]


def hypotheses_of(mixer: np.ndarray, trims: np.ndarray) -> Hypotheses:
    """Draws for a vehicle of this `mixer` (4, 4) whose reference has these trims (4,), the first a logarithm."""
    # Even draws of: two sizes, their sign, two places, four shares of inexactness.
    draws = qmc.Sobol(9, seed=0).random(DRAWS)
    draws = np.clip(draws, 1e-6, 1 - 1e-6)
    sizes = np.abs(norm.ppf(0.5 + 0.5 * draws[:, :2])) * USUAL_CHANGE
    sign = np.where(draws[:, 2] < STRONGER, -1.0, 1.0)
    sizes = sizes * sign[:, None]
    inexact = 1.0 + INEXACT * norm.ppf(draws[:, 5:])
    place_of = {p: k for k, p in enumerate([(0,), (1,), (2,), (3,), *SIDES, EVERYWHERE, ()])}
    # Rotor commands in level flight of the reference, in units of their mean: columns of the inverse mixer.
    level = np.linalg.solve(mixer, np.r_[1.0, trims[1:]])
    signs = 4.0 * mixer[1:3]
    parts = []

    def add(cause, share, factors, places, size):
        command = level * np.maximum(factors, 0.2)
        mixed = command @ mixer.T
        change = np.c_[np.log(mixed[:, 0]), mixed[:, 1:] / mixed[:, :1] - trims[1:]] * inexact
        parts.append((change, np.full(DRAWS, share * CAUSES[cause] / DRAWS), cause, places, size))

    lost = sizes / (1.0 + sizes)  # a rotor that needs 1 + d of its command has lost d / (1 + d)
    for rotor in range(4):
        factors = np.ones((DRAWS, 4))
        factors[:, rotor] += sizes[:, 0]
        add("one rotor weaker", 0.25, factors, np.full(DRAWS, rotor), lost[:, 0])
    for pair, side in SIDES.items():
        factors = np.ones((DRAWS, 4))
        factors[:, pair] += sizes
        places = np.full(DRAWS, place_of[pair])
        for one, other in ((0, 1), (1, 0)):
            alone = np.abs(sizes[:, other]) < LEAST_PARTNER * np.abs(sizes[:, one])
            places[alone] = pair[one]
        add("two rotors weaker", 0.05 if side == "diagonal" else 0.225, factors, places, lost.sum(1))
    # A weight within the circle through the rotors, in units of their distance from the axes.
    radius, angle = np.sqrt(2.0 * draws[:, 3]), 2 * np.pi * draws[:, 4]
    left, rear = radius * np.cos(angle), radius * np.sin(angle)
    weight = sizes[:, 0]
    factors = 1.0 + weight[:, None] * (1.0 + left[:, None] * signs[0] + rear[:, None] * signs[1])
    near = np.clip(0.5 * (left[:, None] * signs[0] + rear[:, None] * signs[1]), -1.0, 1.0)
    places = np.array([place_of.get(_beside(row), place_of[EVERYWHERE]) for row in near])
    add("weight", 1.0, factors, places, 4.0 * weight)
    add(
        "whole vehicle",
        1.0,
        np.repeat(1.0 + sizes[:, :1], 4, 1),
        np.full(DRAWS, place_of[EVERYWHERE]),
        4.0 * weight,
    )
    anything = USUAL_CHANGE / 2 * norm.ppf(draws[:, 5:])
    parts.append((anything, np.full(DRAWS, CAUSES["something else"] / DRAWS), "something else",
                  np.full(DRAWS, place_of[()]), np.abs(anything).sum(1)))  # fmt: skip
    causes = list(CAUSES)
    return Hypotheses(
        *(np.concatenate([p[k] for p in parts]) for k in (0, 1)),
        np.repeat([causes.index(p[2]) for p in parts], DRAWS),
        *(np.concatenate([p[k] for p in parts]) for k in (3, 4)),
        tuple(place_of),
    )


def _beside(near: np.ndarray) -> tuple[int, ...]:
    """The rotors beside a weight, from how near (4,) -1 to 1 it is to each: one, two of a side, or all."""
    order = np.argsort(-near)
    if near[order[0]] < 0.3:
        return EVERYWHERE
    if near[order[0]] - near[order[1]] > 0.4:
        return (int(order[0]),)
    return tuple(sorted(int(i) for i in order[:2]))
