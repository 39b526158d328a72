"""What `openjax map` does: a policy flies with teams of each size, after evaders of each speed,
with each capture radius; how many episodes of each cell end with a capture, and what a theorem
forces.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.baselines.stack import planar_bound, stack_bound
from openjax.errors import UserError
from openjax.evaluation.episodes import make_evaluate, wilson
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings, Task, uniform_task
from openjax.runs.machine import describe_machine
from openjax.runs.options import MapCommand
from openjax.store.policies import LoadedPolicy

FALL_OUT = 2.0
"""Seconds after which a pursuer falls out."""


class Cell(NamedTuple):
    """A game of the map."""

    num_pursuers: int
    speed_ratio: float
    """The evader's speed, as a multiple of the pursuers' maximal one."""
    capture_radius: float
    """m"""


def cells_of(command: MapCommand) -> list[Cell]:
    """All cells, team by team."""
    return [
        Cell(*values)
        for values in itertools.product(command.sizes, command.speed_ratios, command.radii)
    ]


def map_game(command: MapCommand, trained: PursuitSettings) -> PursuitSettings:
    """The game of all cells: a policy's, with slots for the largest team, and nominal vehicles.

    Raises:
      UserError: nothing is asked for, or another number of pursuers than the policy flies with.
    """
    for name in ("sizes", "speed_ratios", "radii"):
        if not getattr(command, name):
            raise UserError(f"--{name} needs at least one number")
    largest = max(command.sizes)
    if not trained.team_sizes and set(command.sizes) != {trained.num_pursuers}:
        raise UserError(
            f"--sizes {' '.join(map(str, command.sizes))}: policy {command.policy} flies with "
            f"{trained.num_pursuers} pursuers only"
        )
    return dataclasses.replace(
        trained.of_one_team(largest),
        evaders=command.evaders,
        vehicles=(),
        rare_vehicles=0.0,
        fall_outs=command.fall_outs,
        fall_out_seconds=(FALL_OUT, FALL_OUT),
        sight_range=command.sight_range,
        sight_angle=command.sight_angle,
    )


def draw_task(game: PursuitSettings, command: MapCommand, key: jax.Array, cell: jax.Array) -> Task:
    """A uniform task in a cell (3,), without pillars where these are left away. Tasks of one key
    differ in nothing else.
    """
    number, ratio, radius = cell
    task = uniform_task(game, key)
    active = None
    if len(set(command.sizes)) > 1:
        active = jnp.arange(game.num_pursuers) < number
    if command.scenario == "empty":
        task = task.replace(pillar_active=jnp.zeros_like(task.pillar_active))
    task = task.replace(active=active, evader_speed=ratio * game.max_speed, capture_radius=radius)
    return task.with_starts(task.pursuer_position)


def draw_map(command: MapCommand, loaded: LoadedPolicy, tell: Callable[[str], None]) -> dict:
    """Fly all cells.

    Args:
      command: which cells, how often.
      loaded: the policy.
      tell: shows a line of progress.

    Returns:
      policy, evaders, scenario, what is taken away, cells (see `cell_record`), seconds, machine.

    Raises:
      UserError: a game that the policy can't play.
    """
    began = time.monotonic()
    game = map_game(command, loaded.settings.environment)
    environment = Pursuit(game)
    loaded = loaded.in_game(environment)
    cells = cells_of(command)
    flown = _fly(command, environment, loaded, cells, tell)
    return {
        "policy": loaded.source,
        "evaders": list(command.evaders),
        "scenario": command.scenario,
        "messages": dataclasses.asdict(command.messages),
        "fall_outs": command.fall_outs,
        "sight": {"range": command.sight_range, "angle": command.sight_angle},
        "game": {
            "arena_radius": game.arena_radius,
            "arena_height": game.arena_height,
            "seconds": game.episode_length * game.time_step,
        },
        "trained_with": list(loaded.settings.environment.team_sizes),
        "cells": [cell_record(game, *pair) for pair in zip(cells, flown, strict=True)],
        "seconds": time.monotonic() - began,
        "machine": describe_machine(),
    }


def _fly(command, environment, loaded, cells, tell):
    """The statistics (episodes,) of each cell."""
    evaluate = make_evaluate(environment, loaded.policy, messages=command.messages)
    game = environment.settings

    @jax.jit
    def fly(keys, cells, key):
        tasks = jax.vmap(lambda key, cell: draw_task(game, command, key, cell))(keys, cells)
        return evaluate(loaded.parameters, tasks, key).statistics

    number = len(cells) * command.episodes
    batch = min(command.batch, number)
    first = jax.random.key(command.seed)
    keys = jax.random.split(first, command.episodes)  # the same tasks in all cells
    parts = []
    for start in range(0, number, batch):
        place = np.minimum(np.arange(start, start + batch), number - 1)
        which, episode = np.divmod(place, command.episodes)
        own_cells = jnp.asarray(cells, jnp.float32)[which]
        statistics = fly(keys[episode], own_cells, jax.random.fold_in(first, 1 + start))
        parts.append(jax.tree.map(np.asarray, statistics))
        tell(f"{min(start + batch, number)} of {number} episodes")
    flown = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:number], *parts)
    starts = range(0, number, command.episodes)
    return [
        jax.tree.map(lambda leaf, start=start: leaf[start : start + command.episodes], flown)
        for start in starts
    ]


def cell_record(game: PursuitSettings, cell: Cell, statistics: EpisodeStatistics) -> dict:
    """A cell's captures with their 95 % interval, crashes and mean capture time (s, of those that
    capture), and the speed ratios below which a theorem forces a capture for points
    (`openjax.baselines.stack`): all on one ray, and as the game in a plane has it.
    """
    episodes = len(statistics.captured)
    caught = statistics.captured
    points = dataclasses.replace(
        game, num_pursuers=cell.num_pursuers, capture_radius=cell.capture_radius
    )
    seconds = statistics.capture_step[caught].mean() * game.time_step if caught.any() else None
    return {
        **cell._asdict(),
        "episodes": episodes,
        "capture_rate": float(caught.mean()),
        "interval": list(wilson(int(caught.sum()), episodes)),
        "capture_seconds": None if seconds is None else float(seconds),
        "crash_rate": float(statistics.crashed.mean()),
        "forced_below": stack_bound(points),
        "planar_below": planar_bound(points),
    }
