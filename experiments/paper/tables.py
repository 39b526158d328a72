"""The paper's tables and figures, by the shipped weights: `python -m experiments.paper.tables
[--episodes 100]`.

Flies every method once, all its layouts, capture radii and evader speeds in one compiled call, and
stores what came of it in experiments/results/tables.json; the page is made from there. `--report`
makes it again.
"""

import argparse
import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper import main_tables, sweeps
from experiments.paper.flights import environment_of, fly
from experiments.paper.roster import ABLATIONS, METHODS, seeds_of
from experiments.table import facts, page_parser, write_page
from openjax.background import compile_ahead
from openjax.baselines import METHODS as HEURISTICS
from openjax.command_line import run_command
from openjax.evaluation.episodes import summarise
from openjax.evaluation.evaluator import layout_slots, repeat_task, stack
from openjax.evaluation.result_tables import record_of
from openjax.files import read_json, write_json
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, Task, scenario_task
from openjax.store.policies import LoadedPolicy, load_policy

NAME = "tab_main"
"""Of the page and its figure."""
LAYOUTS = ("wall", "narrow_gap", "random", "passage", "hidden")
LABELS = (*METHODS, *ABLATIONS)
LIMITS = {"clamp": "clamp", "no clamp": "none"}


@functools.cache
def game_of(name: str, limit: str, physics: str) -> tuple[LoadedPolicy, Pursuit]:
    """A policy, and the game that it flies."""
    policy = load_policy(name)
    game = policy.settings.environment
    # the reward changes nothing that is counted here; one for all saves compilations
    game = dataclasses.replace(
        game,
        max_pillars=layout_slots(game),
        reward=RewardSettings(),
        speed_limit=limit,
        physics=physics,
    )
    environment = environment_of(game)
    return policy.in_game(environment), environment


def cells_of(evader_speed: float, episodes: int) -> list[tuple[str, float, int]]:
    """Layout, evader speed (m/s) and number of what a policy flies in one call."""
    cells = [(layout, evader_speed, episodes) for layout in LAYOUTS]
    return cells + [(layout, speed, max(1, episodes // 2)) for layout, speed in sweeps.CELLS]


def tasks_of(game: PursuitSettings, cells: list[tuple[str, float, int]]) -> dict[int, Task]:
    """The tasks of each cell, by its place."""
    return {
        i: repeat_task(scenario_task(game, SCENARIOS[name]), n)
        for i, (name, _, n) in enumerate(cells)
    }


def call_of(name: str, seed: int, limit: str, physics: str, episodes: int) -> tuple:
    """The arguments of `fly`."""
    policy, environment = game_of(name, limit, physics)
    game = environment.settings
    cells = cells_of(game.evader_speed, episodes)
    return (
        environment,
        policy.policy,
        sweeps.RADII,
        policy.parameters,
        stack(tasks_of(game, cells))[0],
        jnp.concatenate([jnp.full(number, speed, jnp.float32) for _, speed, number in cells]),
        jax.random.key(seed),
    )


def of_policy(name: str, seed: int, limit: str, physics: str, episodes: int) -> dict:
    """By layout: the record of a policy, what it did there, the paths of one episode; and its two
    sweeps.
    """
    call = call_of(name, seed, limit, physics, episodes)
    game = call[0].settings
    cells = cells_of(game.evader_speed, episodes)
    _, part = stack(tasks_of(game, cells))
    parts = list(part(jax.tree.map(np.asarray, fly(*call))).values())
    layouts = {}
    for layout, part in zip(LAYOUTS, parts, strict=False):
        row = record_of(layout, episodes, summarise(part.evaluation), ("last_seen_error",))
        layouts[layout] = {"record": row}
    return {
        "layouts": layouts,
        "sweeps": sweeps.figures(parts[len(LAYOUTS) :], game.episode_length),
    }


def all_calls() -> dict[tuple[str, str], list[tuple[str, int]]]:
    """Policies and seeds by method and condition; heuristics fly without the clamp, too: no
    training chose their speed.
    """
    return {
        (label, condition): seeds_of(label)
        for label in LABELS
        for condition in LIMITS
        if condition == "clamp" or METHODS.get(label) in HEURISTICS
    }


def study(options: argparse.Namespace) -> None:
    """Fly and store all methods and the ablations."""
    start = time.monotonic()
    alike = {"episodes": options.episodes, "physics": options.physics}
    rest = (options.physics, options.episodes)
    calls = all_calls()
    flights = []
    compiled = {}
    # compiled side by side, and while others fly
    for (label, condition), seeds in calls.items():
        for name, seed in seeds[:1]:
            compiled[label, condition] = compile_ahead(
                fly, *call_of(name, seed, LIMITS[condition], *rest)
            )
    for (label, condition), seeds in calls.items():
        if (label, condition) in compiled:
            compiled[label, condition]()
        for name, seed in seeds:
            begin = time.monotonic()
            record = of_policy(name, seed, LIMITS[condition], *rest)
            about = {"method": label, "policy": name, "seed": seed, "condition": condition}
            flights.append({**about, "seconds": time.monotonic() - begin, **record})
            print(f"{time.monotonic() - start:5.0f} s  {label}: {name}, {condition}", flush=True)
        # after each, so that an interrupted study leaves what it has
        seconds = time.monotonic() - start
        results = {**facts(options.commit), "seconds": seconds, **alike, "flights": flights}
        write_json(options.out / "tables.json", results)


def main(arguments: list[str]) -> int:
    """Fly or read the flights, then write the page."""
    parser = page_parser(__doc__, ".")
    parser.add_argument(
        "--episodes", type=int, default=100, help="per seed and layout; half for the sweeps"
    )
    parser.add_argument(
        "--physics", choices=("rigid", "mjx"), default="rigid", help="mjx: the same, slower"
    )
    options = parser.parse_args(arguments)
    if not options.report:
        study(options)
    results = read_json(options.out / "tables.json")
    write_page(options.out / NAME, main_tables.page, results, sweeps.draw)
    return 0


if __name__ == "__main__":
    run_command(main)
