"""The work of `openjax map`: a policy flies with teams of each size, after evaders of each speed,
with each capture radius. It counts how many episodes of each cell end with a capture, beside what a
theorem forces.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.baselines.stack import planar_bound, stack_bound
from openjax.commands.map_evaders import EvaderFlights, MapEvaders, least_caught
from openjax.commands.options import MapCommand
from openjax.errors import UserError
from openjax.evaluation.episodes import wilson
from openjax.pursuit import (
    EpisodeStatistics,
    Pursuit,
    PursuitSettings,
    RewardSettings,
    Task,
    uniform_task,
)
from openjax.runs.machine import describe_machine
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
        Cell(size, speed_ratio, radius)
        for size, speed_ratio, radius in itertools.product(
            command.sizes, command.speed_ratios, command.radii
        )
    ]


def map_game(command: MapCommand, game: PursuitSettings) -> PursuitSettings:
    """The game of all cells: a policy's, with slots for the largest team, and nominal vehicles.

    Raises:
      UserError: nothing is asked for, or another number of pursuers than the policy
      flies with.
    """
    for name in ("sizes", "speed_ratios", "radii"):
        if not getattr(command, name):
            raise UserError(f"--{name} needs at least one number")
    if command.best_response and not command.messages.perfect:
        raise UserError(
            "--best_response: evaders can't learn against a team whose messages are lost or late; "
            "--best_response False flies scripted evaders alone"
        )
    largest = max(command.sizes)
    if not game.team_sizes and set(command.sizes) != {game.num_pursuers}:
        raise UserError(
            f"--sizes {' '.join(map(str, command.sizes))}: policy {command.policy} flies only "
            f"{game.num_pursuers} pursuers"
        )
    return dataclasses.replace(
        game.of_one_team(largest),
        arena_radius=command.arena_radius,
        evaders=command.evaders,
        vehicles=(),
        rare_vehicles=0.0,
        fall_outs=command.fall_outs,
        fall_out_seconds=(FALL_OUT, FALL_OUT),
        sight_range=command.sight_range,
        sight_angle=command.sight_angle,
        # counts for nothing here, and a training's may ask for shortest paths, which
        # cost time and memory
        reward=RewardSettings(),
    )


def draw_task(game: PursuitSettings, command: MapCommand, key: jax.Array, cell: jax.Array) -> Task:
    """A uniform task in a cell (3,), without pillars where these are left away. Tasks
    of one key differ in nothing else.
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


def draw_map(
    command: MapCommand,
    policy: LoadedPolicy,
    tell: Callable[[str], None],
    keep: Callable[[dict], None] | None = None,
) -> dict:
    """Fly all cells.

    Args:
      command: which cells, how often, and against whom.
      policy: who flies.
      tell: shows a line of progress.
      keep: is handed what is known as soon as evaders of a kind have flown, as the
        whole takes minutes and may be cut off.

    Returns:
      policy, evaders, scenario, what is taken away, cells (see `cell_record`), how
      evaders learned, seconds, machine.

    Raises:
      UserError: a game that the policy can't play, or a file of evaders that can't be
      used.
    """
    began = time.monotonic()
    game = map_game(command, policy.settings.environment)
    policy = policy.in_game(Pursuit(game))
    draw = functools.partial(draw_task, game, command)
    flyer = _Flyer(command, draw, tell)
    record = _about(command, game, policy)
    for part in _fly_all(flyer, MapEvaders(command, game, policy, draw)):
        record |= {**part, "seconds": time.monotonic() - began}
        if keep is not None:
            keep(record)
    return record


def _about(command, game, policy):
    """A map's settings, without cells yet."""
    return {
        "policy": policy.source,
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
        "trained_with": list(policy.settings.environment.team_sizes),
        "cells": [],
        "machine": describe_machine(),
    }


def _fly_all(flyer, knowing):
    """Yield what is known after scripted evaders have flown, after others have learned, and after
    those and the planning ones have flown.
    """
    command = flyer.command
    game = knowing.game
    cells = cells_of(command)
    statistics_of = flyer.fly(knowing.scripted, cells)
    records = [
        cell_record(game, cell, statistics)
        for cell, statistics in zip(cells, statistics_of, strict=True)
    ]
    yield {"cells": records}
    if not command.best_response:
        return
    began = time.monotonic()
    learners, curve = knowing.evaders(flyer.tell)
    yield {"curve": curve, "seconds_of_learning": time.monotonic() - began}
    statistics_of = flyer.fly(knowing.learned(learners), cells)
    for record, statistics in zip(records, statistics_of, strict=True):
        record["learned"] = figures(game, _of_least_caught(statistics))
    yield {"cells": records}
    places = _planned_cells(command, len(cells))
    if not places:
        return
    statistics_of = flyer.fly(knowing.planned, [cells[place] for place in places])
    for place, statistics in zip(places, statistics_of, strict=True):
        records[place]["planner"] = figures(game, statistics)
    yield {"cells": records}


def _planned_cells(command, number):
    """Places of the cells, of so many, in which the planner flies."""
    generator = np.random.default_rng(command.seed)
    count = round(command.planner_share * number)
    return np.sort(generator.choice(number, count, replace=False)).tolist()


def cells_against(file: Mapping, evaders: str) -> list[dict]:
    """The cells of a map (see `draw_map`) that evaders of one kind flew, with their
    figures: "scripted", "learned", or "planner".
    """
    if evaders == "scripted":
        return list(file["cells"])
    return [{**cell, **cell[evaders]} for cell in file["cells"] if evaders in cell]


@dataclasses.dataclass(frozen=True)
class _Flyer:
    """Flies episodes in cells, some at a time."""

    command: MapCommand
    draw: Callable[[jax.Array, jax.Array], Task]
    """(key, cell (3,)) -> a task in it"""
    tell: Callable[[str], None]

    def fly(self, flight: EvaderFlights, cells: Sequence[Cell]) -> list[EpisodeStatistics]:
        """The statistics (episodes, ...) of each cell."""
        command = self.command
        episodes = flight.episodes
        number = len(cells) * episodes
        batch = min(max(1, command.batch // flight.width), number)
        first = jax.random.key(command.seed)
        # the same tasks in all cells, whoever flies
        keys = jax.random.split(first, command.episodes)[:episodes]

        @jax.jit
        def fly(networks, keys, cells, key):
            return flight.fly(networks, jax.vmap(self.draw)(keys, cells), key)

        parts = []
        for start in range(0, number, batch):
            # the program knows one size: the last batch is filled up with the last episode
            place = np.minimum(np.arange(start, start + batch), number - 1)
            which, episode = np.divmod(place, episodes)
            values = jnp.asarray(cells, jnp.float32)[which]
            key = jax.random.fold_in(first, 1 + start)
            statistics = fly(flight.networks, keys[episode], values, key)
            parts.append(jax.tree.map(np.asarray, statistics))
            self.tell(f"{flight.name}: {min(start + batch, number)} of {number} episodes")
        results = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:number], *parts)
        starts = range(0, number, episodes)
        return [
            jax.tree.map(lambda leaf, start=start: leaf[start : start + episodes], results)
            for start in starts
        ]


def _of_least_caught(statistics):
    """(E,) of (E, L): of each half of the episodes, those of the learner that is caught
    least in the other half.
    """
    least = least_caught(statistics.captured)
    return jax.tree.map(lambda leaf: leaf[np.arange(len(least)), least], statistics)


def cell_record(game: PursuitSettings, cell: Cell, statistics: EpisodeStatistics) -> dict:
    """A cell's figures with scripted evaders, and the speed ratios below which a
    theorem forces a capture for points (`openjax.baselines.stack`): all on one ray, and
    as the game in a plane has it.
    """
    points = dataclasses.replace(
        game, num_pursuers=cell.num_pursuers, capture_radius=cell.capture_radius
    )
    return {
        **cell._asdict(),
        **figures(game, statistics),
        "forced_below": stack_bound(points),
        "planar_below": planar_bound(points),
    }


def figures(game: PursuitSettings, statistics: EpisodeStatistics) -> dict:
    """Captures of episodes (E,) with their 95 % interval, crashes and mean capture time
    (s, of those that capture).
    """
    is_caught = statistics.captured
    seconds = (
        statistics.capture_step[is_caught].mean() * game.time_step if is_caught.any() else None
    )
    return {
        "episodes": len(is_caught),
        "capture_rate": float(is_caught.mean()),
        "interval": list(wilson(int(is_caught.sum()), len(is_caught))),
        "capture_seconds": None if seconds is None else float(seconds),
        "crash_rate": float(statistics.crashed.mean()),
    }
