"""The headline table from the shipped policies: `python -m experiments.headline [--episodes 100] [--policy NAME ...]`.

Evaluates all shipped seeds of OPEN (or other policies) on all six layouts, with the speed clamp from drawn and from level
starts, and without the clamp, and holds them against this project's goals. Writes experiments/results/headline.json and
.md (`--out`: others); `--report` writes the latter again from the former.
"""

import argparse
import dataclasses
import functools
from pathlib import Path

import numpy as np

from experiments.pages import page_parser, publish, spread, table, where
from openjax.commands.command_line import run_command
from openjax.commands.evaluator import Evaluator, evaluate_scenarios, layout_slots
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
# The paper's table of OPEN and the goals of this project: capture rate, capture step, collision rate.
PAPER = {
    "wall": (0.987, 480, 0.000),
    "narrow_gap": (1.0, 526, 0.017),
    "random": (1.0, 330, 0.011),
    "passage": (1.0, 330, 0.006),
}
GOAL_RATE = 0.99
GOAL_STEP = {"wall": 300, "narrow_gap": 260, "random": 260, "passage": 230}
GOAL_COLLISION = {"wall": 0.0005, "narrow_gap": 0.017, "random": 0.011, "passage": 0.006}
PAPER_PREDICTION = {"wall": 0.054, "narrow_gap": 0.084, "random": 0.109, "passage": 0.081}
EXTRA = ("last_seen_error",)
COLUMNS = {
    "capture_rate": "capture rate",
    "capture_step": "capture step",
    "collision_rate": "collision rate",
    "crash_rate": "crash rate",
    "over_speed_rate": "over speed",
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
    scenarios = [SCENARIOS[name] for name in layouts]
    return evaluate_scenarios(evaluator, loaded.parameters, scenarios, episodes, 0, EXTRA)[0]


def shipped_with_clamp() -> dict[str, TrainSettings]:
    """Settings of the shipped policies that were trained in the paper's game, by name."""
    settings = {name: load_policy(name).settings for name in shipped_policies()}
    return {name: s for name, s in settings.items() if s.environment.speed_limit == "clamp"}


def seeds_of_open() -> list[str]:
    """Those of them with predictor and generator, by seed."""
    settings = shipped_with_clamp()
    whole = [name for name, s in settings.items() if s.predictor.enabled and s.generator.enabled]
    return sorted(whole, key=lambda name: settings[name].seed)


def across_seeds(rows: list[dict], field: str) -> str:
    """Mean and standard deviation over the seeds."""
    digits = 0 if field == "capture_step" else 4 if "collision" in field or "error" in field else 3
    return spread([row[field] for row in rows], digits)


def goals(by_layout: dict[str, list[dict]]) -> list[tuple[str, str, str, bool]]:
    """What is to be reached: figure, goal, value, whether it is; `by_layout` holds a record per seed."""
    rows = []
    for layout, records in by_layout.items():
        lowest = min(row["capture_rate"] for row in records)
        step = float(np.mean([row["capture_step"] for row in records]))
        collision = float(np.mean([row["collision_rate"] for row in records]))
        crash = max(row["crash_rate"] for row in records)
        if layout in GOAL_STEP or layout == "hidden":
            rows.append(
                (
                    f"{layout}: capture rate, each seed",
                    f"≥ {GOAL_RATE}",
                    f"{lowest:.2f}",
                    lowest > GOAL_RATE - 1e-6,
                )
            )
        if layout in GOAL_STEP:
            goal = GOAL_STEP[layout]
            rows.append((f"{layout}: capture step", f"≤ {goal}", f"{step:.0f}", step <= goal))
            goal = GOAL_COLLISION[layout]
            rows.append((f"{layout}: collision rate", f"≤ {goal}", f"{collision:.4f}", collision <= goal))
            rows.append((f"{layout}: crash rate, each seed", "0", f"{crash:.2f}", crash == 0))
    return rows


def report(results: dict) -> list[str]:
    """The page."""
    records = results["records"]
    names = list(next(iter(records.values())))
    episodes = next(iter(records.values()))[names[0]][0]["episodes"]
    by_layout = {
        condition: {layout: [by_policy[name][i] for name in names] for i, layout in enumerate(SCENARIOS)}
        for condition, by_policy in records.items()
    }
    first = by_layout[next(iter(CONDITIONS))]
    lines = [
        "# Headline: policies on the six layouts",
        "",
        f"{where(results)} "
        f"{len(names)} training seeds ({', '.join(names)}), {episodes} episodes each per layout; mean (standard deviation "
        f"over seeds). The layouts were never trained on nor used to choose checkpoints. {results['note']}",
        "",
        "## Goals (clamp, drawn starts)",
        "",
    ]
    lines += table(
        ["figure", "goal", "value", "reached"],
        [[*entries, "yes" if reached else "no"] for *entries, reached in goals(first)],
    )
    for condition, layouts in by_layout.items():
        lines += ["", f"## {condition}", ""]
        lines += table(
            ["layout", "capture rate, lowest seed", *COLUMNS.values(), "paper: rate, step, collisions"],
            [
                [
                    layout,
                    f"{min(row['capture_rate'] for row in rows):.2f}",
                    *(across_seeds(rows, field) for field in COLUMNS),
                    "{:.3f}, {}, {:.3f}".format(*PAPER[layout]) if layout in PAPER else "–",
                ]
                for layout, rows in layouts.items()
            ],
        )
    lines += ["", "## Prediction of the next position (m), clamp, drawn starts", ""]
    errors = ("prediction_error", "last_seen_error")
    return lines + table(
        ["layout", "predictor", "keeping the last seen position", "paper"],
        [
            [layout, *(across_seeds(rows, field) for field in errors), str(PAPER_PREDICTION.get(layout, "–"))]
            for layout, rows in first.items()
        ],
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
    trained = "How the policies were trained: h200_runs.md, ablations.md."
    parser.add_argument("--note", default=trained, help="what to say of the policies")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
