"""The six test layouts, and a user's own as a TOML file."""

import dataclasses
import itertools
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError, suggestion
from openjax.files import read_toml
from openjax.plain import from_plain
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.task import Task
from openjax.vehicle.solids import DRONE_RADIUS

MOST_PILLARS = 32
"""Of a layout; each costs time in every step."""
LONGEST_NAME = 80

FLIGHT_HEIGHT = 0.5
"""All vehicles of the six layouts start at this height (m)."""


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A named layout; positions in metres, world frame."""

    name: str
    pillars: tuple[tuple[float, float], ...]
    pursuers: tuple[tuple[float, float, float], ...]
    evader: tuple[float, float, float]


def _layout(name, pillars, pursuers, evader):
    def lift(xy):
        return (*xy, FLIGHT_HEIGHT)

    return Scenario(name, tuple(pillars), tuple(lift(xy) for xy in pursuers), lift(evader))


# The starts of the layouts "empty" and "hidden", close together on the right.
_RIGHT = ((0.6, 0.0), (0.8, 0.0), (0.8, -0.2))

# The first five are the released code's; in "hidden" nobody sees the evader at the
# start.
SCENARIOS: dict[str, Scenario] = {
    layout.name: layout
    for layout in (
        _layout(
            "wall",
            ((0.0, 0.15), (0.0, -0.15), (0.0, 0.45), (0.0, -0.45)),
            ((0.6, 0.4), (0.6, 0.0), (0.6, -0.4)),
            (-0.8, 0.0),
        ),
        _layout(
            "narrow_gap",
            ((0.3, 0.3), (0.3, -0.3), (-0.3, 0.3), (-0.3, -0.3), (0.0, 0.3)),
            ((0.0, 0.7), (0.2, 0.7), (-0.2, 0.7)),
            (-0.5, 0.2),
        ),
        _layout(
            "random",
            ((0.6, 0.4), (-0.6, 0.4), (-0.2, 0.4), (0.0, 0.2), (-0.2, -0.4), (0.0, -0.2)),
            ((0.6, 0.0), (0.8, 0.0), (0.8, -0.2)),
            (-0.8, 0.0),
        ),
        _layout(
            "passage",
            ((0.0, 0.3), (0.2, 0.3), (-0.2, 0.3), (0.0, -0.2), (0.2, -0.2), (-0.2, -0.2)),
            ((0.6, 0.0), (0.8, 0.2), (0.8, -0.2)),
            (0.0, 0.6),
        ),
        _layout("empty", (), _RIGHT, (-0.8, 0.0)),
        _layout(
            "hidden",
            ((0.0, 0.0), (0.0, 0.2), (0.0, -0.2), (-0.4, 0.4), (-0.4, -0.4)),
            _RIGHT,
            (-0.8, 0.0),
        ),
    )
}


def scenario_task(settings: PursuitSettings, scenario: Scenario) -> Task:
    """The scenario as a task with `settings.max_pillars` slots.

    Raises:
      UserError: it has more pillars than that, or not `settings.num_pursuers` pursuers.
    """
    slots = settings.max_pillars
    pillar_number = len(scenario.pillars)
    if pillar_number > slots:
        raise UserError(
            f"scenario {scenario.name}: {pillar_number} pillars do not fit into "
            f"{slots} slots (max_pillars)"
        )
    if len(scenario.pursuers) != settings.num_pursuers:
        raise UserError(
            f"scenario {scenario.name}: has {len(scenario.pursuers)} pursuers, the environment "
            f"{settings.num_pursuers}"
        )
    pillars = np.zeros((slots, 2), np.float32)
    pillars[:pillar_number] = np.asarray(scenario.pillars, np.float32).reshape(pillar_number, 2)
    return Task(
        pursuer_position=jnp.asarray(scenario.pursuers, jnp.float32),
        evader_position=jnp.asarray(scenario.evader, jnp.float32),
        pillar_position=jnp.asarray(pillars),
        pillar_active=jnp.asarray(np.arange(slots) < pillar_number),
    )


def find_scenario(name_or_path: str, settings: PursuitSettings) -> Scenario:
    """A scenario by its name, or read from a TOML file.

    The file holds `pillars` (list of [x, y]), `pursuers` (list of [x, y, z]) and
    `evader` ([x, y, z]), in metres, and optionally a `name`.

    Raises:
      UserError: no such name or file, a wrong entry, a pillar outside the arena or over
      a start, a start outside.
    """
    if name_or_path in SCENARIOS:
        return SCENARIOS[name_or_path]
    path = Path(name_or_path)
    if path.suffix != ".toml":
        raise UserError(
            f"scenario {name_or_path}: no such layout, nor a .toml file; "
            f"{suggestion(str(name_or_path), SCENARIOS)}"
        )
    entries = {"name": path.stem, "pillars": [], **read_toml(path, "layout")}
    scenario = from_plain(Scenario, entries, f"{path}: ")
    if faults := _faults(scenario, settings):
        raise UserError(f"{path}: {faults[0]}")
    return scenario


def _wrong_counts(layout: Scenario) -> list[str]:
    """Say how many pursuers, pillars and characters of a name there are, if that can't be."""
    faults = []
    if not 1 <= len(layout.pursuers) <= 8:
        faults.append(f"has {len(layout.pursuers)} pursuers; 1 to 8 are possible")
    if len(layout.pillars) > MOST_PILLARS:
        faults.append(f"has {len(layout.pillars)} pillars; up to {MOST_PILLARS} are possible")
    name = layout.name
    if len(name) > LONGEST_NAME or not name.isprintable() or not name.strip():
        faults.append(f"its name isn't a line of up to {LONGEST_NAME} printable characters")
    return faults


def _faults(layout: Scenario, settings: PursuitSettings) -> list[str]:
    """The faults of a layout."""
    pursuers = layout.pursuers
    pillars = layout.pillars
    radius = settings.arena_radius
    height = settings.arena_height
    starts = [
        *((f"pursuer {i + 1}", p) for i, p in enumerate(pursuers)),
        ("the evader", layout.evader),
    ]
    # where a drone would stand inside the pillar; a start that only breaches is a fair
    # task
    reach = settings.pillar_radius + DRONE_RADIUS
    faults = _wrong_counts(layout)
    faults += [
        f"pillar {pillar} stands outside the arena of radius {radius} m"
        for pillar in pillars
        if math.hypot(*pillar) > radius
    ]
    faults += [
        f"{who} starts at {(x, y, z)}, outside the arena of {radius} m by {height} m"
        for who, (x, y, z) in starts
        if math.hypot(x, y) > radius or not 0.0 < z < height
    ]
    faults += [
        f"pillar {pillar} stands over the start of {who} (within {reach} m)"
        for who, start in starts
        for pillar in pillars
        if math.dist(start[:2], pillar) < reach
    ]
    return faults + [
        f"two pursuers start inside each other at {a} and {b}"
        for a, b in itertools.combinations(pursuers, 2)
        if math.dist(a, b) < 2 * DRONE_RADIUS
    ]
