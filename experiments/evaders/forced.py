"""What inertia takes away: `python -m experiments.evaders.forced --json FILE [--map
FILE ...]`.

In the cells of the map in which a theorem forces a capture for points
(`openjax.baselines.stack`), it flies stack by points, who should catch in all of them,
and stack by vehicles, from the same starts. With the map of a policy (`openjax map
--json FILE`) its captures in the same cells stand beside.
"""

import argparse
import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaders.points import game_of_points, stack_team
from openjax.baselines import Heuristic
from openjax.baselines.stack import stack_bound
from openjax.commands.catch_map import Cell, cells_of, draw_task
from openjax.commands.options import MapCommand
from openjax.evaluation.episodes import wilson
from openjax.files import read_json, write_json
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.evaders.kinds import HELD_OUT
from openjax.runs.machine import describe_machine

WITHIN = 0.95
"""Cells count whose speed ratio is below this share of the bound: at the bound itself a
capture takes for ever.
"""


def forced_cells(command: MapCommand, size: int) -> list[Cell]:
    """Those of a size in which stack forces a capture."""

    def is_forced(cell):
        game = PursuitSettings(num_pursuers=size, capture_radius=cell.capture_radius)
        return cell.speed_ratio < WITHIN * stack_bound(game)

    return [cell for cell in cells_of(command) if cell.num_pursuers == size and is_forced(cell)]


def fly(environment: Pursuit, act, command: MapCommand, cells: list[Cell]) -> np.ndarray:
    """(cells, episodes) whether each episode ends with a capture; `act` observation ->
    (N, 4).
    """

    def one(key, cell):
        task = draw_task(environment.settings, command, key, cell)
        world = environment.reset_to(key, task)

        def step(world, _):
            observation, state, *_ = environment.step(key, world[1], act(world[0]))
            return (observation, state), None

        length = environment.settings.episode_length
        return jax.lax.scan(step, world, length=length)[0][1].statistics.captured

    keys = jax.random.split(jax.random.key(command.seed), command.episodes)
    fly_all = jax.jit(jax.vmap(jax.vmap(one, (0, None)), (None, 0)))
    return np.asarray(fly_all(keys, jnp.asarray(cells, jnp.float32)))


def flown(size: int, command: MapCommand) -> dict:
    """Both teams in the cells of a size."""
    cells = forced_cells(command, size)
    alike = dict(num_pursuers=size, evaders=command.evaders)
    points = game_of_points(**alike)
    team = stack_team(points)
    vehicles = Pursuit(PursuitSettings(speed_limit="none", **alike))
    stack = Heuristic.for_environment("stack", vehicles)
    parameters = stack.parameters()
    kinds = {
        "points": fly(points, lambda seen: team.act({}, seen), command, cells),
        "vehicles": fly(vehicles, lambda seen: stack.act(parameters, seen), command, cells),
    }
    records = []
    for place, cell in enumerate(cells):
        record = dict(cell._asdict())
        for kind, caught in kinds.items():
            hits = int(caught[place].sum())
            interval = list(wilson(hits, command.episodes))
            record[kind] = {"capture_rate": hits / command.episodes, "interval": interval}
        records.append(record)
    return {
        "pursuers": size,
        "cells": records,
        **{kind: float(caught.mean()) for kind, caught in kinds.items()},
    }


def of_policy(paths: list[Path], teams: list[dict]) -> list[dict]:
    """A policy's captures in the same cells, means by size of team that its maps
    have.
    """
    cells = {
        tuple(cell[name] for name in Cell._fields): cell
        for path in paths
        for cell in read_json(path)["cells"]
    }
    rows = []
    for team in teams:
        places = [tuple(own[name] for name in Cell._fields) for own in team["cells"]]
        same = [cells[place] for place in places if place in cells]
        if not same:
            continue
        row = {
            "pursuers": team["pursuers"],
            "scripted": float(np.mean([cell["capture_rate"] for cell in same])),
        }
        if all("learned" in cell for cell in same):
            row["learned"] = float(np.mean([cell["learned"]["capture_rate"] for cell in same]))
        rows.append(row)
    return rows


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", nargs="+", type=int, default=[3, 4, 6, 8])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--map", type=Path, nargs="*", default=[], help="of a policy")
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    command = dataclasses.replace(
        MapCommand(), evaders=HELD_OUT, episodes=options.episodes, scenario="empty"
    )
    found = {"episodes": options.episodes, "machine": describe_machine(), "teams": []}
    for size in options.sizes:
        began = time.monotonic()
        # of one size, so that no slot is empty
        found["teams"].append(flown(size, dataclasses.replace(command, sizes=(size,))))
        row = {name: value for name, value in found["teams"][-1].items() if name != "cells"}
        print(row, f"{time.monotonic() - began:.0f} s", flush=True)
        write_json(options.json, found)
    if options.map:
        found["policy"] = of_policy(options.map, found["teams"])
        write_json(options.json, found)
        print(found["policy"])


if __name__ == "__main__":
    main()
