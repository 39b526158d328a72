"""The shipped policies on the six layouts: `python -m experiments.paper.headline [--episodes 100] [--policy NAME ...]`.

All shipped seeds of OPEN (or other policies), with the speed clamp from drawn and from level starts, and without the clamp.
Writes experiments/results/headline.json and .md (`--out`: others); `--report` writes the latter again from the former.
"""

import argparse
import dataclasses
import functools
from pathlib import Path

import jax

from experiments.paper.values import PREDICTION, means
from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import Evaluator, layout_slots, layout_tasks
from openjax.learning import TrainSettings
from openjax.policy import Policy
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings
from openjax.store.policies import load_policy
from openjax.store.policy_files import shipped_policies

CONDITIONS = {
    "clamp, drawn starts": {"speed_limit": "clamp", "start_attitude": "drawn"},
    "clamp, level starts": {"speed_limit": "clamp", "start_attitude": "level"},
    "no clamp, drawn starts": {"speed_limit": "none", "start_attitude": "drawn"},
}
EXTRA = ("last_seen_error",)
COLUMNS = {
    "layout": "scenario",
    "capture rate, lowest seed": lambda row: f"{min(row['capture_rate']):.2f}",
    "capture rate": "capture_rate:.3f",
    "capture step": "capture_step:.0f",
    "collision rate": "collision_rate:.4f",
    "crash rate": "crash_rate:.3f",
    "over speed": "over_speed_rate:.3f",
    "paper: rate, step, collisions": "paper",
}
ERRORS = {
    "layout": "scenario",
    "predictor": "prediction_error:.4f",
    "keeping the last seen position": "last_seen_error:.4f",
    "paper": "paper_error",
}


@functools.cache
def evaluator_of(settings: PursuitSettings, policy: Policy, episodes: int) -> Evaluator:
    """One compiled evaluation for all policies of a kind."""
    return Evaluator(Pursuit(settings), policy, episodes)


def fly(
    policy: str | Path, changes: dict, episodes: int, layouts: tuple[str, ...] = tuple(SCENARIOS)
) -> list[dict]:
    """Records of one policy on the layouts, in the game that it was trained in with `changes`."""
    loaded = load_policy(policy)
    settings = loaded.settings.environment
    settings = dataclasses.replace(settings, max_pillars=layout_slots(settings), **changes)
    evaluator = evaluator_of(settings, loaded.policy, episodes)
    tasks = layout_tasks(settings, [SCENARIOS[name] for name in layouts], episodes)
    flown = evaluator.fly(loaded.parameters, tasks, jax.random.key(0))
    return [kind.record(EXTRA) for kind in flown]


def shipped_with_clamp() -> dict[str, TrainSettings]:
    """Settings of the shipped policies that were trained in the paper's game, by name."""
    settings = {name: load_policy(name).settings for name in shipped_policies()}
    return {name: s for name, s in settings.items() if s.environment.speed_limit == "clamp"}


def seeds_of_open() -> list[str]:
    """Those of them with predictor and generator, by seed."""
    settings = shipped_with_clamp()
    whole = [name for name, s in settings.items() if s.predictor.enabled and s.generator.enabled]
    return sorted(whole, key=lambda name: settings[name].seed)


def by_layout(by_policy: dict[str, list[dict]]) -> list[dict]:
    """A record per layout with each figure's values, one per policy, and the paper's."""
    rows = []
    for records in zip(*by_policy.values(), strict=True):
        layout = records[0]["scenario"]
        paper = means(layout, "OPEN")
        seeds = {name: [record.get(name) for record in records] for name in records[0]}
        shown = "{:.3f}, {}, {:.3f}".format(*paper) if paper else None
        rows.append(seeds | {"scenario": layout, "paper": shown, "paper_error": PREDICTION.get(layout)})
    return rows


def page(results: dict) -> Page:
    """A table per condition, then the errors of the prediction."""
    tables = {condition: by_layout(records) for condition, records in results["records"].items()}
    first = next(iter(results["records"].values()))
    episodes = next(iter(first.values()))[0]["episodes"]
    return Page(
        "Policies on the six layouts",
        f"{len(first)} training seeds ({', '.join(first)}), {episodes} episodes each per layout; mean (standard deviation "
        "over seeds). The layouts were never trained on nor used to choose checkpoints. " + results["note"],
        (
            *(Table(COLUMNS, rows, condition) for condition, rows in tables.items()),
            Table(
                ERRORS,
                next(iter(tables.values())),
                "Prediction of the next position (m), clamp, drawn starts",
            ),
        ),
    )


def study(options: argparse.Namespace) -> dict:
    """Fly the policies under all conditions."""
    names = options.policy or seeds_of_open()
    records = {
        condition: {name: fly(name, changes, options.episodes) for name in names}
        for condition, changes in CONDITIONS.items()
    }
    return {
        "note": options.note,
        "records": records,
    }


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "headline")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument(
        "--policy", nargs="+", help="shipped names, runs or policy files; by default OPEN's seeds"
    )
    trained = "How the policies were trained: h200_runs.md."
    parser.add_argument("--note", default=trained, help="what to say of the policies")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
