"""The headline table from the shipped policies: `python experiments/headline.py [--episodes 100]`.

Evaluates the three seeds of OPEN (and plain MAPPO) on all six layouts, with the speed clamp from drawn and from level
starts, and without the clamp. Writes experiments/results/headline.json and .md.
"""

import argparse
import dataclasses
import functools
import time
from pathlib import Path

import numpy as np

from openjax.policy import Policy
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings
from openjax.runs.evaluation import Evaluator, evaluate_scenarios, layout_slots
from openjax.runs.machine import describe_machine
from openjax.runs.policies import load_policy
from openjax.runs.settings_files import write_json

RESULTS = Path(__file__).parent / "results"
SEEDS = ("open", "open_seed_0", "open_seed_1")
CONDITIONS = {
    "clamp, drawn starts": {"speed_limit": "clamp", "start_attitude": "drawn"},
    "clamp, level starts": {"speed_limit": "clamp", "start_attitude": "level"},
    "no clamp, drawn starts": {"speed_limit": "none", "start_attitude": "drawn"},
}
# The paper's table and the goals of this project: capture rate, capture step, collision rate.
PAPER = {
    "wall": (0.987, 480, 0.000),
    "narrow_gap": (1.0, 526, 0.017),
    "random": (1.0, 330, 0.011),
    "passage": (1.0, 330, 0.006),
}
GOAL_STEP = {"wall": 300, "narrow_gap": 260, "random": 260, "passage": 230}
GOAL_COLLISION = {"wall": 0.0005, "narrow_gap": 0.017, "random": 0.011, "passage": 0.006}
PAPER_PREDICTION = {"wall": 0.054, "narrow_gap": 0.084, "random": 0.109, "passage": 0.081}
EXTRA = ("last_seen_error",)


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


def across_seeds(rows: list[dict], field: str) -> str:
    """Mean and sample standard deviation over the seeds."""
    values = [row[field] for row in rows if row[field] is not None]
    if not values:
        return "–"
    digits = 0 if field == "capture_step" else 4 if "collision" in field or "error" in field else 3
    deviation = f" ({np.std(values, ddof=1):.{digits}f})" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{deviation}"


def main() -> None:
    """Evaluate and write both files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    started = time.monotonic()
    records = {
        condition: {name: fly(name, changes, arguments.episodes) for name in (*SEEDS, "mappo")}
        for condition, changes in CONDITIONS.items()
    }
    machine = describe_machine()
    write_json(
        RESULTS / "headline.json",
        {
            "command": f"python experiments/headline.py --episodes {arguments.episodes}",
            "machine": machine,
            "seconds": time.monotonic() - started,
            "records": records,
        },
    )
    lines = [
        "# Headline: the shipped policies on the six layouts",
        "",
        f"`python experiments/headline.py --episodes {arguments.episodes}` on {machine['device']}, JAX "
        f"{machine['versions']['jax']}, commit {machine['commit']}. Three training seeds, {arguments.episodes} episodes "
        "each per layout; mean (standard deviation over seeds). The layouts were never trained on nor used to choose "
        "checkpoints. How the policies were trained: h200_runs.md.",
    ]
    for condition, by_policy in records.items():
        lines += [
            "",
            f"## {condition}",
            "",
            "| layout | capture rate, lowest seed | capture rate | capture step | "
            "collision rate | crash rate | over speed | goals: step, collisions | paper: rate, step, collisions |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for i, layout in enumerate(SCENARIOS):
            rows = [by_policy[name][i] for name in SEEDS]
            goal = f"≤ {GOAL_STEP[layout]}, ≤ {GOAL_COLLISION[layout]}" if layout in GOAL_STEP else "–"
            paper = "{:.3f}, {}, {:.3f}".format(*PAPER[layout]) if layout in PAPER else "–"
            lines.append(
                f"| {layout} | {min(row['capture_rate'] for row in rows):.2f} | "
                + " | ".join(
                    across_seeds(rows, f)
                    for f in (
                        "capture_rate",
                        "capture_step",
                        "collision_rate",
                        "crash_rate",
                        "over_speed_rate",
                    )
                )
                + f" | {goal} | {paper} |"
            )
    lines += [
        "",
        "## Prediction of the next position (m), clamp, drawn starts",
        "",
        "| layout | predictor | keeping the last seen position | paper |",
        "|---|---|---|---|",
    ]
    for i, layout in enumerate(SCENARIOS):
        rows = [records["clamp, drawn starts"][name][i] for name in SEEDS]
        lines.append(
            f"| {layout} | {across_seeds(rows, 'prediction_error')} | {across_seeds(rows, 'last_seen_error')} | "
            f"{PAPER_PREDICTION.get(layout, '–')} |"
        )
    (RESULTS / "headline.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
