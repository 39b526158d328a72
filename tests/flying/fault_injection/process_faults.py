"""What goes wrong in a flight of real processes: its kinds, and one of them drawn."""

import math
import random
from dataclasses import replace
from itertools import combinations

from tests.flying.fault_injection.faults import BEYOND, CAMERA, GONE, RADIO, WILD, Fault, draw_fault

ROLES = ("loop", "links", "guard")
SIGNALS = ("KILL", "STOP", "TERM", "HUP", "INT", "TSTP", "QUIT")
UNSENT = {k for k in (*CAMERA, *RADIO) if "clock" in k or "order" in k}
UNSENT |= {*BEYOND, "poses: a number that is none", "poses: no attitude"}
"""No packet, or adapter, can say so; or nothing mends it."""
KEYS = {
    "key l": "l", "key h, l a second later": "h…l", "h and l": "hl", "Ctrl-C": "\x03", "Ctrl-Z": "\x1a", "Ctrl-\\": "\x1c",
    "space": " ", "q": "q", "space and l": " l", "l and space": "l ", "x x space": "xx ", "an arrow and space": "\x1b[A ",
    "Ctrl-C and space": "\x03 ", "Ctrl-C three times": "\x03\x03\x03",
}  # fmt: skip
STOPPED = ("space", "q")
"""In these keys' names: motors off at once."""
START = {
    "start: y up": ("camera: y up", 1.0), "start: millimetres": ("camera scaled", 1e3), "start: scaled": ("camera scaled", 1.3),
    "start: yaw turned": ("camera: yaw turned", 1.0), "start: beside the mark": ("camera moved", 0.3),
}  # fmt: skip
"""What is wrong with motion capture before anything flies, and by how much."""
GROUPS = {
    "a signal to one process": [f"{name} {role}" for name in SIGNALS for role in ROLES],
    "to several processes": (
        "TERM group", "HUP group", *(f"{name} {a}+{b}" for name in ("KILL", "STOP") for a, b in combinations(ROLES, 2)),
        "KILL links then guard", "KILL loop then links", "KILL links then space", "KILL links+guard then space",
        *(f"STOP {role} then CONT" for role in (*ROLES, "loop+links+guard")),
    ),
    "keys, terminal closed": (*KEYS, "terminal closed"),
    "motion capture": [kind for kind in CAMERA if kind not in UNSENT],
    "own estimates, links": [kind for kind in (*RADIO, *GONE) if kind not in UNSENT],
    "the policy": ("policy: a number that is none", *WILD, "policy fails"),
    "wrong from the start": tuple(START),
    "strangers, a second fly, nothing": ("strangers' packets", "none", "second fly", "none with camera"),
}  # fmt: skip
KINDS = [kind for kinds in GROUPS.values() for kind in kinds]
DRAWN = (*GROUPS["motion capture"], *GROUPS["own estimates, links"], *GROUPS["the policy"][:-1])
"""Faults as in simulated time."""
ENDLESS = (*DRAWN, *GROUPS["strangers, a second fly, nothing"])
"""These needn't end a flight."""
LATEST = 6.0
"""s after the take-off."""


def ends_flight(kind: str) -> bool:
    """Whether a fault of this kind must end its flight; links and guard are deaf to a
    terminal's signals.
    """
    name, _, target = kind.partition(" ")
    deaf = name in SIGNALS[2:] and target in ("links", "guard")
    return not (deaf or kind in ENDLESS or kind in START)


def fault_of(number: int, kind: str) -> Fault:
    """The fault with this number and kind."""
    rng = random.Random(number)
    time = rng.uniform(0.3, LATEST)
    vehicle = rng.randrange(3)
    if kind in DRAWN:
        faults = (draw_fault(seed, LATEST) for seed in range(1000 * number, 1000 * number + 1000))
        return replace(next(like for like in faults if like.kind == kind), time=time)
    if kind in START:
        kind, amount = START[kind]
        return Fault(kind, -2.0, vehicle, math.inf, amount)
    return Fault(kind, time, vehicle, direction=0.0 if "camera" in kind else 4.0)
