"""The paper's tables and figures from the shipped weights: `python experiments/tables.py [--episodes 100]`, or `make tables`.

Flies every method on the layouts once and stores what came of it in experiments/results/tables.json; then each script
named in `PAGES` writes its page from there, and sweeps.py flies its own. `--report` writes the pages again.
"""

import argparse
import dataclasses
import functools
import time
from pathlib import Path

import behaviours
import jax
import learning_curves
import numpy as np
import sweeps
import tab_main
import tab_ood
import tab_prediction
from pages import RESULTS
from roster import ABLATIONS, METHODS, seeds_of

from openjax.commands.command_line import run_command
from openjax.commands.evaluator import Evaluator, layout_slots, record_of, repeat_task
from openjax.commands.machine import describe_machine
from openjax.learning import summarise
from openjax.policy import Policy
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, scenario_task
from openjax.store.policies import load_policy
from openjax.store.settings_files import write_json

PAGES = (tab_main, tab_ood, tab_prediction, behaviours)
LAYOUTS = ("wall", "narrow_gap", "random", "passage", "hidden")
OOD_LAYOUTS = ("random", "passage")
CONDITIONS = {"clamp": {"speed_limit": "clamp"}, "no clamp": {"speed_limit": "none"}}


@functools.cache
def evaluator_of(settings: PursuitSettings, policy: Policy, episodes: int) -> Evaluator:
    """One compiled evaluation for all policies of a kind."""
    return Evaluator(Pursuit(settings), policy, episodes)


def fly(name: str, seed: int, layouts: tuple[str, ...], changes: dict, episodes: int) -> dict[str, dict]:
    """By layout: the record of a policy, what it did there, and the paths of one episode."""
    loaded = load_policy(name)
    game = loaded.settings.environment
    # the reward changes nothing that is counted here; one for all saves compilations
    game = dataclasses.replace(game, max_pillars=layout_slots(game), reward=RewardSettings(), **changes)
    evaluator = evaluator_of(game, loaded.policy, episodes)
    flown = {}
    for layout in layouts:
        task = scenario_task(game, SCENARIOS[layout])
        evaluation, batches = evaluator(loaded.parameters, repeat_task(task, episodes), jax.random.key(seed))
        paths = jax.tree.map(np.asarray, batches[0].replace(predicted=None))
        row = record_of(layout, episodes, summarise(evaluation), ("last_seen_error",))
        flown[layout] = {
            "record": row,
            "behaviour": behaviours.measure(layout, paths, evaluation.statistics),
            "paths": behaviours.one_episode(paths),
        }
    return flown


def study(options: argparse.Namespace) -> dict:
    """Every method on the paper's layouts and where the evader hides; the ablations where the paper shows them."""
    started = time.monotonic()
    flights = []
    for label in (*METHODS, *ABLATIONS):
        layouts = LAYOUTS if label in METHODS else OOD_LAYOUTS
        # what learning isn't in flies honest physics too: its speed is its own choice
        conditions = CONDITIONS if label in ("Angelani", "Janosov", "APF") else {"clamp": CONDITIONS["clamp"]}
        for condition, changes in conditions.items():
            for name, seed in seeds_of(label):
                changes = {**changes, "physics": options.physics}
                flown = fly(name, seed, layouts, changes, options.episodes)
                flights.append(
                    {"method": label, "policy": name, "seed": seed, "condition": condition, "layouts": flown}
                )
                print(f"{time.monotonic() - started:5.0f} s  {label}: {name}, {condition}", flush=True)
    return {
        "command": f"python experiments/tables.py --episodes {options.episodes} --physics {options.physics}",
        "commit": options.commit,
        "machine": describe_machine(),
        "seconds": time.monotonic() - started,
        "episodes": options.episodes,
        "flights": flights,
    }


def main(arguments: list[str]) -> int:
    """Fly or read the flights, then write all pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--report", action="store_true", help="from the stored flights")
    parser.add_argument("--episodes", type=int, default=100, help="per seed and layout")
    parser.add_argument("--physics", choices=("rigid", "mjx"), default="rigid", help="mjx: the same, slower")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    parser.add_argument("--out", type=Path, default=RESULTS, help="directory")
    options = parser.parse_args(arguments)
    flights = options.out / "tables.json"
    if not options.report:
        write_json(flights, study(options))
    for page in PAGES:
        page.main(["--flights", str(flights), "--out", str(options.out / page.__name__)])
    learning_curves.main(["--out", str(options.out / "learning_curves")])
    episodes = str(max(1, options.episodes // 2))
    swept = ["--report"] if options.report else ["--episodes", episodes, "--physics", options.physics]
    sweeps.main([*swept, "--commit", options.commit, "--out", str(options.out / "sweeps")])
    return 0


if __name__ == "__main__":
    run_command(main)
