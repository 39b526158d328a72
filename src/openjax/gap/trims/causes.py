"""Effects of a cause on a flight's trims: draws of its size, its place and how well
real changes follow its pattern.

    one rotor weaker by a share e   hover, roll, pitch and yaw move alike, with the signs
                                    of the rotor's place and spin
    two rotors weaker               the sum of two such
    a weight                        beside a rotor or a side: hover, roll and pitch, no yaw
    the whole vehicle               hover alone (mass, propellers, thrust)
    motors                          the lag from motors to angular acceleration, and a
                                    little the gains' estimate
    gains                           the commands per rate error
    something else                  trims without a pattern

A rotor that is weaker by e at the same command is given 1 / (1 - e) of it. What is cut,
bent or taped on also shakes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

from openjax.gap.decision import DECISION
from openjax.gap.trims.figures import PLACES, TRIMS


@dataclass(frozen=True)
class Cause:
    """A possible change, how probable it is if something did, and the effects of
    the library that it is.
    """

    prior: float
    effects: tuple[str, ...] = ()
    damage: bool = False  # it also shakes
    figures: tuple[str, ...] = ()  # that it moves instead of the trims
    # mean and standard deviation of such a change
    usual: tuple[float, float] = (0.0, 0.0)
    what: str = ""


# Drag and inertia move nothing of this; a diagnosis names them. Gains it often can't, as
# it asks for quick turns.
CAUSES = {
    "one rotor weaker": Cause(DECISION.rotor_prior, ("motor_imbalance",), damage=True),
    "two rotors weaker": Cause(DECISION.rotors_prior, ("motor_imbalance",), damage=True),
    "weight": Cause(DECISION.weight_prior, ("mass", "com_offset"), damage=True),
    "whole vehicle": Cause(DECISION.vehicle_prior, ("mass", "thrust_scale")),
    "motors": Cause(
        DECISION.motors_prior, ("motor_lag",), False, ("lag",), (0.2, 0.5), "motors' lag"
    ),
    "gains": Cause(
        DECISION.gains_prior, ("rate_gains",), False, ("loop_gain",), (0.0, 0.5), "rate gains"
    ),
    "something else": Cause(DECISION.other_prior),
}
LOOP_WITH_MOTORS = 0.3  # standard deviation: motors move the estimate of the gain too
# mean and standard deviation of the rise of the logarithm with a damage
SHAKES = (0.4, 0.4)
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
    """Draws from all causes: change of the figures (N, F), prior weight, cause, place
    and size of each.
    """

    change: np.ndarray
    weight: np.ndarray
    cause: np.ndarray  # (N,) index into CAUSES
    place: np.ndarray  # (N,) index into `places`
    size: np.ndarray
    places: tuple[tuple[int, ...], ...]


class _Draws:
    """Even draws that all causes share, and the parts that they make of them."""

    def __init__(self, mixer: np.ndarray, trims: np.ndarray):
        # a normal's quantiles at the very ends are infinite
        even = np.clip(qmc.Sobol(11, seed=0).random(DRAWS), 1e-6, 1 - 1e-6)
        sign = np.where(even[:, 2] < DECISION.mended, -1.0, 1.0)
        usual = DECISION.usual_change * sign[:, None]
        self.sizes = np.abs(norm.ppf(0.5 + 0.5 * even[:, :2])) * usual
        self.places, self.normal = even[:, 3:5], norm.ppf(even[:, 5:])
        self.mixer = mixer
        self.trims = trims
        self.place_of = {
            p: k for k, p in enumerate([(0,), (1,), (2,), (3,), *SIDES, EVERYWHERE, ()])
        }
        self.parts: list[tuple] = []

    def add(self, cause: str, share: float, change: dict, place, size: np.ndarray) -> None:
        """Draws of a cause at a place; `change`: {figure: (DRAWS,)}."""
        table = np.zeros((DRAWS, len(PLACES)))
        for name, values in change.items():
            table[:, PLACES[name]] = values
        if CAUSES[cause].damage:
            table[:, PLACES["shaking"]] = SHAKES[0] + SHAKES[1] * self.normal[:, 4]
        weight = np.full(DRAWS, share * CAUSES[cause].prior / DRAWS)
        rotor = np.broadcast_to(
            place if isinstance(place, np.ndarray) else self.place_of[place], DRAWS
        )
        self.parts.append((table, weight, np.full(DRAWS, list(CAUSES).index(cause)), rotor, size))

    def trims_of(self, factors: np.ndarray) -> dict:
        """What rotor commands that rise by `factors` (DRAWS, 4) do to the trims,
        inexactly.
        """
        change = trims_with(self.mixer, self.trims, np.maximum(factors, 0.2))
        change = change * (1.0 + DECISION.pattern_error * self.normal[:, :4])
        return dict(zip(TRIMS, change.T, strict=True))


def trims_with(mixer: np.ndarray, trims: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Change (..., 4) of a reference's trims (4,) where the rotor commands of its level
    flight rise by `factors` (..., 4).
    """
    wrench = (np.linalg.solve(mixer, np.r_[1.0, trims[1:]]) * factors) @ mixer.T
    return np.concatenate(
        [np.log(wrench[..., :1]), wrench[..., 1:] / wrench[..., :1] - trims[1:]], -1
    )


def hypotheses_of(mixer: np.ndarray, trims: np.ndarray) -> Hypotheses:
    """Draws for a vehicle of this `mixer` (4, 4) whose reference has these trims (4,),
    the first a logarithm.
    """
    draws = _Draws(mixer, trims)
    _rotors(draws)
    _weights(draws)
    for cause, cause_card in CAUSES.items():
        if not cause_card.figures:
            continue
        size = cause_card.usual[0] + cause_card.usual[1] * draws.normal[:, 0]
        each = {
            n: size * (1 + DECISION.pattern_error * draws.normal[:, k + 1])
            for k, n in enumerate(cause_card.figures)
        }
        if cause == "motors":
            each["loop_gain"] = LOOP_WITH_MOTORS * size * draws.normal[:, 2]
        draws.add(cause, 1.0, each, (), size)
    anything = DECISION.usual_change / 2 * draws.normal[:, :4]
    each = dict(zip(TRIMS, anything.T, strict=True))
    draws.add("something else", 1.0, each, (), np.abs(anything).sum(1))
    parts = zip(*draws.parts, strict=True)
    change, weight, cause, place, sizes = (np.concatenate(part) for part in parts)
    return Hypotheses(change, weight, cause, place, sizes, tuple(draws.place_of))


def _rotors(draws: _Draws) -> None:
    """One rotor weaker, or two."""
    sizes, losses = (
        draws.sizes,
        draws.sizes / (1.0 + draws.sizes),
    )  # one that needs 1 + d has lost d / (1 + d)
    for rotor in range(4):
        factors = np.ones((DRAWS, 4))
        factors[:, rotor] += sizes[:, 0]
        draws.add("one rotor weaker", 0.25, draws.trims_of(factors), (rotor,), losses[:, 0])
    for pair, side in SIDES.items():
        factors = np.ones((DRAWS, 4))
        factors[:, pair] += sizes
        places = np.full(DRAWS, draws.place_of[pair])
        for one, other in ((0, 1), (1, 0)):
            least = DECISION.least_partner * np.abs(sizes[:, one])
            is_single = np.abs(sizes[:, other]) < least
            places[is_single] = pair[one]
        share = 0.05 if side == "diagonal" else 0.225
        draws.add("two rotors weaker", share, draws.trims_of(factors), places, losses.sum(1))


def _weights(draws: _Draws) -> None:
    """A weight within the circle through the rotors, and one that all carry alike."""
    # In units of the rotors' distance from the axes.
    radius = np.sqrt(2.0 * draws.places[:, 0])
    angle = 2 * np.pi * draws.places[:, 1]
    lateral, rear = (radius * f(angle) for f in (np.cos, np.sin))
    signs = 4.0 * draws.mixer[1:3]
    weight = draws.sizes[:, 0]
    beside = lateral[:, None] * signs[0] + rear[:, None] * signs[1]
    nearness = np.clip(0.5 * beside, -1.0, 1.0)
    places = np.array([draws.place_of[_beside(row)] for row in nearness])
    factors = 1.0 + weight[:, None] * (1.0 + beside)
    draws.add("weight", 1.0, draws.trims_of(factors), places, 4.0 * weight)
    alike = np.repeat(1.0 + draws.sizes[:, :1], 4, 1)
    draws.add("whole vehicle", 1.0, draws.trims_of(alike), EVERYWHERE, 4.0 * weight)


def _beside(nearness: np.ndarray) -> tuple[int, ...]:
    """The rotors beside a weight, from how near (4,) -1 to 1 it is to each: one, two of
    a side, or all.
    """
    order = np.argsort(-nearness)
    if nearness[order[0]] < 0.3:
        return EVERYWHERE
    if nearness[order[0]] - nearness[order[1]] > 0.4:
        return (int(order[0]),)
    return tuple(sorted(int(i) for i in order[:2]))
