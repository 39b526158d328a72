"""The evaders by name: a behaviour, and the values of its numbers, one of which is
drawn for each world.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from openjax.errors import UserError, part_name, suggestion

MEMORY = 4
"""Numbers that a scripted evader remembers; drawn uniformly from 0 to 1 at the start of
an episode.
"""
UNBOUNDED = 1e6
"""An acceleration (m/s^2) that bounds nothing."""


@dataclass(frozen=True)
class EvaderKind:
    """One evader. Where a number has several values, each world draws one of them, with
    equal odds.
    """

    behaviour: str | Callable[[Any, Any], tuple[Any, Any]]
    """A name in `openjax.pursuit.evaders.behaviours.BEHAVIOURS`; "field" is the
    paper's, which has none of these numbers. Or a function of one's own,
    velocity(scene, memory) -> velocity (3,) in m/s in the world, memory: `Scene` says
    what it knows, `memory` has as many numbers.
    """
    of: Literal["train", "validation", "held out", "file"] = "train"
    """Its permitted use: held-out ones are never trained on, nor are checkpoints
    chosen by them. "file": it comes from one, or is handed in.
    """
    look_ahead: tuple[float, ...] = (0.15,)
    """Seconds after which it looks at where a direction leads."""
    hiding: tuple[float, ...] = (0.0,)
    """A pursuer that wouldn't see it counts as this much farther (m)."""
    sees_all: tuple[bool, ...] = (True,)
    """True if it knows of all pursuers, or of those in its sight."""
    acceleration: tuple[float, ...] = (UNBOUNDED,)
    """The largest rate of change of its velocity while nothing is in its way (m/s^2)."""
    speed: tuple[float, ...] = (1.0,)
    """Its speed, as a share of the game's `evader_speed`."""
    memory: int = MEMORY
    """Numbers that a function of one's own remembers: the first four are drawn as
    `MEMORY` says, others begin as zeros.
    """


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
    # slow enough to be caught by whoever dares to come near: without it, some teams
    # wait a pillar's width away for good
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
    # the name, in settings, of one that is handed in: Pursuit(settings, evaders=(...))
    "own": EvaderKind("own", "file"),
}
SCRIPTED = tuple(name for name, kind in EVADERS.items() if kind.of != "file")


def _of(split):
    return tuple(name for name, kind in EVADERS.items() if kind.of == split)


VALIDATED = _of("validation")
HELD_OUT = _of("held out")


Evader = str | EvaderKind | Callable[[Any, Any], tuple[Any, Any]]
"""An evader as it may be given: a name, a row, or a row's behaviour alone."""


def evader_rows(
    names: tuple[str, ...], handed_in: tuple[EvaderKind, ...] = ()
) -> tuple[EvaderKind, ...]:
    """The row of each name; those called "own" are the ones that were `handed_in`, in
    their order.

    Raises:
      UserError: settings name one that wasn't handed in.
    """
    if names.count("own") != len(handed_in):
        raise UserError(
            "evader own: a name isn't enough; Pursuit(settings, evaders=(...)) takes a function, "
            "or --opponent FILE.py:function or a file of openjax exploit"
        )
    rest = iter(handed_in)
    return tuple(next(rest) if name == "own" else EVADERS[name] for name in names)


def handed_in(evaders: Any) -> tuple[tuple[str, ...], tuple[EvaderKind, ...]]:
    """Names of evaders for the settings, and the rows of those that have none.

    Raises:
      UserError: something that is no evader, or no tuple of them.
    """
    if not isinstance(evaders, tuple | list):
        raise UserError(f"evaders: {part_name(evaders)} is no tuple; (evader, ...) would be right")
    for one in evaders:
        if not (isinstance(one, str | EvaderKind) or callable(one)):
            raise UserError(
                f"evaders: {part_name(one)} is no evader; a name, an EvaderKind or a "
                "function (scene, memory) -> velocity, memory would be right"
            )
    rows = [EvaderKind(one, "file") if callable(one) else one for one in evaders]
    names = tuple(one if isinstance(one, str) else "own" for one in rows)
    return names, tuple(one for one in rows if isinstance(one, EvaderKind))


def check_evaders(names: tuple[str, ...]) -> None:
    """Raises UserError for no evader, or one that nobody knows."""
    if not names:
        raise UserError(
            "environment.evaders is empty; it names at least one evader, for example field"
        )
    for name in names:
        if name not in EVADERS:
            raise UserError(f"evader {str(name)[:60]}: unknown; {suggestion(str(name), SCRIPTED)}")
