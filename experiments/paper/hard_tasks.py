"""Rare failures of policies, on tasks enough to count them: `python -m experiments.paper.hard_tasks [--policy NAME ...]`.

The layouts' hundred episodes can't tell a crash in a hundred from one in a thousand, and nothing may be chosen by them.
So policies are compared on three kinds of other tasks: uniform ones, uniform ones with their pillars in a row (which
hide the evader and have to be flown round), and uniform ones turned about the axis in which every pursuer that can be
starts close to a pillar or another pursuer. Writes experiments/results/hard_tasks.json and .md.
"""

import jax

from experiments.paper.headline import evaluator_of, seeds_of_open
from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.commands.validation import uniform_tasks
from openjax.learning import summarise
from openjax.pursuit import PursuitSettings, close_starts, line_up_pillars, turn_task, uniform_task
from openjax.store.policies import load_policy

KEY = 77_000_001
"""From which rows and close starts are drawn, the same for all policies."""
BATCH = 512
"""Episodes per call of the compiled evaluation."""


def row(settings: PursuitSettings, key: jax.Array):
    """A uniform task with its pillars in a row."""
    task_key, row_key = jax.random.split(key)
    return line_up_pillars(settings, row_key, uniform_task(settings, task_key))


def close(settings: PursuitSettings, key: jax.Array):
    """A turned uniform task in which as many pursuers as possible start close to something."""
    task_key, turn_key, close_key = jax.random.split(key, 3)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    return close_starts(settings, close_key, task, 1.0)


def drawn(settings: PursuitSettings, draw, number: int):
    """`number` tasks by `draw(settings, key)`."""
    keys = jax.random.split(jax.random.key(KEY), number)
    return jax.jit(jax.vmap(lambda key: draw(settings, key)))(keys)


def fly(policy: str, number: int) -> dict[str, dict]:
    """Summary per kind of task, in the game in which the policy was trained; `number` uniform tasks."""
    loaded = load_policy(policy)
    settings = loaded.settings.environment
    evaluator = evaluator_of(settings, loaded.policy, BATCH)
    kinds = {
        "uniform": uniform_tasks(settings, number, settings.max_pillars),
        "row": drawn(settings, row, number // 4),
        "close": drawn(settings, close, number // 2),
    }
    found = {}
    for kind, tasks in kinds.items():
        evaluation, _ = evaluator(loaded.parameters, tasks, jax.random.key(0))
        found[kind] = {
            "episodes": len(evaluation.statistics.crashed),
            "crashes": int(evaluation.statistics.crashed.sum()),
            **summarise(evaluation),
        }
    return found


def page(results: dict) -> Page:
    """A row per policy and kind of task."""
    columns = {
        "policy": "policy",
        "tasks": "tasks",
        "crashes": lambda row: f"{row['crashes']} of {row['episodes']}",
        "collision rate": "collision_rate:.4f",
        "capture rate": "capture_rate:.4f",
        "capture step": "capture_step:.0f",
    }
    rows = [
        {"policy": name, "tasks": kind, **found}
        for name, kinds in results["policies"].items()
        for kind, found in kinds.items()
    ]
    return Page(
        "Rare failures, on many tasks",
        "Uniform: validation uniform tasks; row: their pillars in a row; close: all pursuers that can be start close to a "
        "pillar or another pursuer. Each policy in the game that it was trained in; start attitudes drawn.",
        Table(columns, rows),
    )


def study(options) -> dict:
    """Fly the policies."""
    names = options.policy or seeds_of_open()
    return {"policies": {name: fly(name, options.number) for name in names}}


def main(arguments: list[str]) -> int:
    """Evaluate and write both files."""
    parser = page_parser(__doc__, "hard_tasks")
    parser.add_argument("--policy", nargs="+", help="names, runs or policy files; by default OPEN's seeds")
    parser.add_argument(
        "--number", type=int, default=4096, help="uniform tasks; a quarter and half of it of the others"
    )
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
