"""Where an evader can't be reached: `python -m experiments.evaders.pockets`.

An evader keeps .02 m from pillars and bounds; a pursuer that is to touch nothing keeps
its own radius and a margin from pillars and floor, and, where breaches count, from wall
and ceiling. For each place of the evader that is open to it from its start: how far is
the nearest place, open to the pursuers from theirs, from which it is in sight? Where
that is more than the capture radius, nobody catches an evader that stays. Seen from
above on a grid: pillars reach to the ceiling.
"""

import argparse
import dataclasses
import json

import jax
import numpy as np
from scipy import ndimage

from openjax.evaluation.judges.tasks import judging_tasks
from openjax.pursuit import SCENARIOS, PursuitSettings
from openjax.pursuit.collisions import TOUCH
from openjax.pursuit.evaders.behaviours import MARGIN
from openjax.pursuit.task import uniform_task
from openjax.vehicle.solids import DRONE_RADIUS

CELL = 0.01
"""Of the grid (m)."""
SPAN = 1.2
"""Half the width of the grid (m): the arena and a pursuer's way round it outside."""
FARTHEST = 0.45
"""Distances are looked for up to this (m)."""
MARGINS = (0.0, 0.02, 0.05, 0.09)
"""That pursuers keep for their control (m)."""
AXIS = np.arange(-SPAN, SPAN + CELL / 2, CELL)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), axis=-1)


@dataclasses.dataclass(frozen=True)
class Rules:
    """How near pursuers may come."""

    margin: float
    """To everything, for control (m)."""
    breaches: bool
    """Whether they also keep the paper's distances and stay inside the arena."""


def pillar_gap(pillars: np.ndarray, radius: float) -> np.ndarray:
    """(X, Y) m, from each place of the grid to the surface of the nearest of (P, 2)
    pillars.
    """
    if not len(pillars):
        return np.full(GRID.shape[:2], np.inf)
    return np.linalg.norm(GRID[:, :, None] - pillars, axis=-1).min(-1) - radius


def connected(free: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The part of a set (X, Y) that is joined to one of the places (K, 2)."""
    names = ndimage.label(free)[0]
    cells = np.rint((starts + SPAN) / CELL).astype(int)
    reached = {names[x, y] for x, y in cells}
    # a start may lie a hair inside of a margin
    for x, y in cells:
        reached |= set(names[x - 3 : x + 4, y - 3 : y + 4].ravel())
    return np.isin(names, list(reached - {0}))


def sees(a: np.ndarray, b: np.ndarray, pillars: np.ndarray, radius: float) -> np.ndarray:
    """(K,) whether no pillar lies between places (K, 2)."""
    way = b - a
    to_axis = pillars - a[:, None]
    along = np.einsum("kpd,kd->kp", to_axis, way) / np.maximum((way**2).sum(-1), 1e-12)[:, None]
    across = to_axis - along[..., None] * way[:, None]
    blocked = ((across**2).sum(-1) < radius**2) & (along >= 0) & (along <= 1)
    return ~blocked.any(-1)


def distances(game, pillars, pursuers, evader, rules: Rules) -> tuple[np.ndarray, np.ndarray]:
    """Places (K, 2) of an evader at the height that is worst, and their distances (K,)
    m from the nearest place of a pursuer in sight; infinite beyond `FARTHEST`.
    """
    gap = pillar_gap(pillars, game.pillar_radius)
    rho = np.linalg.norm(GRID, axis=-1)
    open_to_evader = connected(
        (gap >= MARGIN) & (rho <= game.arena_radius - MARGIN), evader[None, :2]
    )
    near = game.pillar_clearance if rules.breaches else DRONE_RADIUS + TOUCH
    free = gap >= near + rules.margin
    free &= rho <= (game.arena_radius - rules.margin if rules.breaches else SPAN)
    free = connected(free, pursuers[:, :2])
    floor = DRONE_RADIUS + TOUCH + rules.margin - MARGIN
    ceiling = rules.margin - MARGIN if rules.breaches else 0.0
    apart = max(floor, ceiling, 0.0)

    cells = np.argwhere(open_to_evader)
    found = np.where(free[tuple(cells.T)], 0.0, np.inf)
    reach = int(FARTHEST / CELL)
    steps = np.stack(np.mgrid[-reach : reach + 1, -reach : reach + 1], axis=-1).reshape(-1, 2)
    length = CELL * np.linalg.norm(steps, axis=-1)
    order = np.argsort(length)
    order = order[length[order] <= FARTHEST]
    left = np.flatnonzero(np.isinf(found))
    for step, far in zip(steps[order], length[order], strict=True):
        if not left.size:
            break
        there = np.clip(cells[left] + step, 0, len(AXIS) - 1)
        hit = np.flatnonzero(free[tuple(there.T)])
        if hit.size and len(pillars):
            places = (GRID[tuple(there[hit].T)], GRID[tuple(cells[left[hit]].T)])
            hit = hit[sees(*places, pillars, game.pillar_radius)]
        found[left[hit]] = far
        left = np.delete(left, hit)
    return GRID[tuple(cells.T)], np.hypot(found, apart)


def summary(game, pillars, pursuers, evader, rules: Rules) -> dict:
    """Of one task: the deepest place (m), where it is, and the share of places out of
    reach.
    """
    places, far = distances(game, pillars, pursuers, evader, rules)
    worst = int(np.argmax(far))
    return {
        "deepest": float(far[worst]),
        "where": [round(float(x), 2) for x in places[worst]],
        "out_of_reach": float((far >= game.capture_radius).mean()),
    }


def tasks_of(tasks):
    """Single tasks of (B, ...) as arrays: pillars in use, pursuers, evader."""
    tasks = jax.tree.map(np.asarray, tasks)
    for i in range(len(tasks.evader_position)):
        used = tasks.pillar_active[i]
        yield (tasks.pillar_position[i][used], tasks.pursuer_position[i], tasks.evader_position[i])


def main() -> None:
    """Prints a record a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=int, default=64, help="of each kind of drawn ones")
    options = parser.parse_args()
    game = PursuitSettings()
    rules = [Rules(m, b) for b in (False, True) for m in MARGINS]
    kinds = {
        name: [(np.array(s.pillars).reshape(-1, 2), np.array(s.pursuers), np.array(s.evader))]
        for name, s in SCENARIOS.items()
    }
    kinds["uniform"] = list(tasks_of(judging_tasks(game, options.tasks)))
    for most in (5, 7):
        settings = dataclasses.replace(game, min_pillars=0, max_pillars=most)
        keys = jax.random.split(jax.random.key(most), options.tasks)
        drawn = jax.vmap(lambda key, settings=settings: uniform_task(settings, key))(keys)
        kinds[f"training, 0 to {most}"] = list(tasks_of(drawn))
    for name, tasks in kinds.items():
        for rule in rules:
            found = [summary(game, *task, rule) for task in tasks]
            deep = np.array([one["deepest"] for one in found])
            print(
                json.dumps(
                    {
                        "kind": name,
                        **dataclasses.asdict(rule),
                        "deepest": round(float(deep.max()), 3),
                        "with_pocket": float((deep >= game.capture_radius).mean()),
                        "out_of_reach": float(np.mean([one["out_of_reach"] for one in found])),
                        "where": found[int(deep.argmax())]["where"],
                    }
                ),
                flush=True,
            )


if __name__ == "__main__":
    main()
