"""The evaders by name: a behaviour, and the values of its numbers, one of which is drawn for each
world.
"""

from dataclasses import dataclass
from typing import Literal

from openjax.errors import UserError, suggestion

UNBOUNDED = 1e6
"""An acceleration (m/s^2) that bounds nothing."""


@dataclass(frozen=True)
class EvaderKind:
    """One evader. Where a number has several values, each world draws one of them, with equal
    odds.
    """

    behaviour: str
    """A name in `openjax.pursuit.evaders.behaviours.BEHAVIOURS`; "field" is the paper's, which has
    none of these numbers.
    """
    of: Literal["train", "validation", "held out", "file"]
    """What it may be used for: held-out ones are never trained on, nor are checkpoints chosen by
    them. "file": it is read from one.
    """
    look_ahead: tuple[float, ...] = (0.15,)
    """Seconds after which it looks at where a direction leads."""
    hiding: tuple[float, ...] = (0.0,)
    """A pursuer that wouldn't see it counts as this much farther (m)."""
    sees_all: tuple[bool, ...] = (True,)
    """Whether it knows of all pursuers, or of those in its sight."""
    acceleration: tuple[float, ...] = (UNBOUNDED,)
    """How fast its velocity changes at most where nothing is in its way (m/s^2)."""
    speed: tuple[float, ...] = (1.0,)
    """Its speed, as a share of the game's `evader_speed`."""


NUMBERS = ("look_ahead", "hiding", "sees_all", "acceleration", "speed")
"""The fields of `EvaderKind` that are drawn."""

EVADERS = {
    "field": EvaderKind("field", "train"),
    "greedy": EvaderKind(
        "greedy",
        "train",
        look_ahead=(0.1, 0.15, 0.2, 0.3, 0.5),
        hiding=(0.0, 0.3),
        sees_all=(True, True, False),
    ),
    "wall_runner": EvaderKind("wall_runner", "train", speed=(0.8, 1.0)),
    # slow enough to be caught by whoever dares to come near: without it, some teams wait a pillar's
    # width away for good
    "slow_hugger": EvaderKind("pillar_hugger", "train", speed=(0.4, 0.7)),
    "heavy": EvaderKind(
        "greedy", "validation", look_ahead=(0.2,), acceleration=(8.0,), hiding=(0.0, 0.3)
    ),
    "pillar_hugger": EvaderKind("pillar_hugger", "validation"),
    "greedy_far": EvaderKind("greedy", "held out", look_ahead=(0.4,)),
    "greedy_near": EvaderKind("greedy", "held out", look_ahead=(0.05,), hiding=(0.3,)),
    "two_step": EvaderKind("two_step", "held out"),
    "safe_place": EvaderKind("safe_place", "held out"),
    "way_points": EvaderKind("way_points", "held out"),
    "frozen": EvaderKind("frozen", "held out"),
    "learned": EvaderKind("learned", "file"),
}
SCRIPTED = tuple(name for name, kind in EVADERS.items() if kind.of != "file")


def _of(split):
    return tuple(name for name, kind in EVADERS.items() if kind.of == split)


TRAINED = _of("train")
VALIDATED = _of("validation")
HELD_OUT = _of("held out")


def check_evaders(names: tuple[str, ...]) -> None:
    """Raises UserError for no evader, or one that nobody knows."""
    if not names:
        raise UserError(
            "environment.evaders is empty; it names at least one evader, for example field"
        )
    for name in names:
        if name not in EVADERS:
            raise UserError(f"evader {str(name)[:60]}: unknown; {suggestion(str(name), SCRIPTED)}")
