"""The shipped policies on the six layouts: `python -m experiments.paper.headline [--episodes 100] [--policy NAME ...]`.

All shipped seeds of OPEN (or other policies), with the speed clamp from drawn and from level starts, and without the clamp.
Writes experiments/results/headline.json and .md (`--out`: others); `--report` writes the latter again from the former.
"""

import argparse

from experiments.paper.roster import seeds_of
from experiments.paper.values import means
from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.commands.evaluate import EvaluateCommand, fly_scenarios
from openjax.ranges import changed
from openjax.store.policies import load_policy

CONDITIONS = {
    "clamp, drawn starts": {"speed_limit": "clamp", "start_attitude": "drawn"},
    "clamp, level starts": {"speed_limit": "clamp", "start_attitude": "level"},
    "no clamp, drawn starts": {"speed_limit": "none", "start_attitude": "drawn"},
}
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


def fly(name: str, changes: dict, episodes: int, evaluators: dict) -> list[dict]:
    """Records of one policy on the layouts, in the game that it was trained in with `changes`."""
    loaded = load_policy(name)
    game = changed(loaded.settings.environment, **changes)
    command = EvaluateCommand(policy=(name,), episodes=episodes, environment=game)
    return fly_scenarios(command, loaded, evaluators)[0]


def by_layout(by_policy: dict[str, list[dict]]) -> list[dict]:
    """A record per layout with each figure's values, one per policy, and the paper's."""
    rows = []
    for records in zip(*by_policy.values(), strict=True):
        layout = records[0]["scenario"]
        paper = means(layout, "OPEN")
        seeds = {name: [record.get(name) for record in records] for name in records[0]}
        shown = "{:.3f}, {}, {:.3f}".format(*paper) if paper else None
        rows.append(seeds | {"scenario": layout, "paper": shown})
    return rows


def page(results: dict) -> Page:
    """A table per condition."""
    tables = {condition: by_layout(records) for condition, records in results["records"].items()}
    first = next(iter(results["records"].values()))
    episodes = next(iter(first.values()))[0]["episodes"]
    return Page(
        "Policies on the six layouts",
        f"{len(first)} training seeds ({', '.join(first)}), {episodes} episodes each per layout; mean (standard deviation "
        "over seeds). The layouts were never trained on nor used to choose checkpoints. " + results["note"],
        [Table(COLUMNS, rows, condition) for condition, rows in tables.items()],
    )


def study(options: argparse.Namespace) -> dict:
    """Fly the policies under all conditions."""
    names, evaluators = options.policy or [name for name, _ in seeds_of("OPEN")], {}
    records = {
        condition: {name: fly(name, changes, options.episodes, evaluators) for name in names}
        for condition, changes in CONDITIONS.items()
    }
    return {"note": options.note, "records": records}


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
