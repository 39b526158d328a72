"""The paper's tables and figures from the shipped weights: `python -m experiments.tables [--episodes 100]`, or `make tables`.

Flies every method once, all its layouts, capture radii and evader speeds in one compiled call, and stores what came of it in
experiments/results/tables.json; each script named in `PAGES` then writes its page from there. `--report` writes the pages
again.
"""

import argparse
import dataclasses
import functools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import behaviours, learning_curves, sweeps, tab_main, tab_ood, tab_prediction
from experiments.flights import environment_of, fly
from experiments.pages import RESULTS
from experiments.roster import ABLATIONS, METHODS, seeds_of
from openjax.baselines import METHODS as HEURISTICS
from openjax.cluster.compilation import compile_ahead
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots, record_of, repeat_task
from openjax.commands.machine import describe_machine
from openjax.files import read_json, write_text
from openjax.learning import summarise
from openjax.pursuit import SCENARIOS, Pursuit, RewardSettings, scenario_task
from openjax.store.policies import LoadedPolicy, load_policy
from openjax.store.settings_files import to_plain

PAGES = (tab_main, tab_ood, tab_prediction, behaviours, sweeps)
LAYOUTS = ("wall", "narrow_gap", "random", "passage", "hidden")
LABELS = (*METHODS, *ABLATIONS)
LIMITS = {"clamp": "clamp", "no clamp": "none"}


@functools.cache
def game_of(name: str, limit: str, physics: str) -> tuple[LoadedPolicy, Pursuit]:
    """A policy, and the game that it flies."""
    loaded = load_policy(name)
    game = loaded.settings.environment
    # the reward changes nothing that is counted here; one for all saves compilations
    game = dataclasses.replace(
        game, max_pillars=layout_slots(game), reward=RewardSettings(), speed_limit=limit, physics=physics
    )
    environment = environment_of(game)
    return loaded.in_game(environment), environment


def cells_of(evader_speed: float, episodes: int) -> list[tuple[str, float, int]]:
    """Layout, evader speed (m/s) and number of what a policy flies in one call."""
    cells = [(layout, evader_speed, episodes) for layout in LAYOUTS]
    return cells + [(layout, speed, max(1, episodes // 2)) for layout, speed in sweeps.CELLS]


def call_of(name: str, seed: int, limit: str, physics: str, episodes: int) -> tuple:
    """The arguments of `fly`."""
    loaded, environment = game_of(name, limit, physics)
    game = environment.settings
    cells = cells_of(game.evader_speed, episodes)
    tasks = [repeat_task(scenario_task(game, SCENARIOS[layout]), number) for layout, _, number in cells]
    return (
        environment,
        loaded.policy,
        sweeps.RADII,
        loaded.parameters,
        jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *tasks),
        jnp.concatenate([jnp.full(number, speed, jnp.float32) for _, speed, number in cells]),
        jax.random.key(seed),
    )


def of_policy(name: str, seed: int, limit: str, physics: str, episodes: int) -> dict:
    """By layout: the record of a policy, what it did there, the paths of one episode; and its two sweeps."""
    call = call_of(name, seed, limit, physics, episodes)
    game = call[0].settings
    cells = cells_of(game.evader_speed, episodes)
    flown = fly(*call)
    flown = jax.tree.map(np.asarray, flown)
    ends = np.cumsum([number for *_, number in cells])
    parts = [
        jax.tree.map(lambda leaf, end=end, number=number: leaf[end - number : end], flown)
        for end, (*_, number) in zip(ends, cells, strict=True)
    ]
    layouts = {}
    for layout, part in zip(LAYOUTS, parts, strict=False):
        row = record_of(layout, episodes, summarise(part.evaluation), ("last_seen_error",))
        layouts[layout] = {
            "record": row,
            "behaviour": behaviours.measure(layout, part.paths, part.evaluation.statistics),
            "paths": behaviours.one_episode(part.paths),
        }
    return {"layouts": layouts, "sweeps": sweeps.figures(parts[len(LAYOUTS) :], game.episode_length)}


def study(options: argparse.Namespace) -> None:
    """Fly and store all methods and the ablations, with the clamp; heuristics without it, too: no training chose their speed.

    What stands in the file already of methods that aren't named is kept, if it was flown alike.
    """
    started = time.monotonic()
    alike = {"episodes": options.episodes, "physics": options.physics}
    stored = options.out / "tables.json"
    kept = read_json(stored) if stored.exists() and len(options.methods) < len(LABELS) else {}
    kept = kept.get("flights", []) if {name: kept.get(name) for name in alike} == alike else []
    flights = [flight for flight in kept if flight["method"] not in options.methods]
    wanted = [
        (label, condition)
        for label in options.methods
        for condition in LIMITS
        if condition == "clamp" or METHODS.get(label) in HEURISTICS
    ]
    rest = (options.physics, options.episodes)
    compiled = {}
    for label, condition in wanted:  # all programs are compiled side by side, and while others fly
        for name, seed in seeds_of(label)[:1]:
            compiled[label, condition] = compile_ahead(fly, *call_of(name, seed, LIMITS[condition], *rest))
    for label in options.methods:
        for condition, limit in LIMITS.items():
            if (label, condition) not in compiled:
                continue
            compiled[label, condition]()
            for name, seed in seeds_of(label):
                begun = time.monotonic()
                flown = of_policy(name, seed, limit, *rest)
                if condition != "clamp" or (name, seed) != seeds_of(label)[0]:
                    for layout in flown["layouts"].values():  # one episode of each method is drawn
                        del layout["paths"]
                flights.append(
                    {
                        "method": label,
                        "policy": name,
                        "seed": seed,
                        "condition": condition,
                        "seconds": time.monotonic() - begun,
                        **flown,
                    }
                )
                print(f"{time.monotonic() - started:5.0f} s  {label}: {name}, {condition}", flush=True)
        # after each method, so that an interrupted study leaves what it has
        command = f"python -m experiments.tables --episodes {options.episodes} --physics {options.physics}"
        results = {"command": command, "commit": options.commit, "machine": describe_machine()}
        results |= {"seconds": time.monotonic() - started, **alike, "flights": flights}
        # paths are long: no line for each number
        write_text(stored, json.dumps(to_plain(results), allow_nan=False, separators=(",", ":")))


def main(arguments: list[str]) -> int:
    """Fly or read the flights, then write all pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--report", action="store_true", help="from the stored flights")
    parser.add_argument("--episodes", type=int, default=100, help="per seed and layout; half for the sweeps")
    parser.add_argument("--physics", choices=("rigid", "mjx"), default="rigid", help="mjx: the same, slower")
    parser.add_argument("--methods", nargs="+", choices=LABELS, default=list(LABELS), help="fly these anew")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    parser.add_argument("--out", type=Path, default=RESULTS, help="directory")
    options = parser.parse_args(arguments)
    flights = options.out / "tables.json"
    if not options.report:
        study(options)
    for page in PAGES:
        page.main(["--flights", str(flights), "--out", str(options.out / page.__name__.rpartition(".")[2])])
    learning_curves.main(["--out", str(options.out / "learning_curves")])
    return 0


if __name__ == "__main__":
    run_command(main)
