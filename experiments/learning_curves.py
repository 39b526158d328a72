"""Learning curves from committed histories: `python -m experiments.learning_curves [RUN ...]`.

Capture rate, capture step and collision rate on the validation tasks against environment steps: OPEN (h200_runs.json) and
the other methods as shipped, each trained under penalties with which it learns to catch (method_runs.json, in which a RUN of
`openjax.train` takes the place of those of its variant). Writes experiments/results/learning_curves.md and .png.
"""

import argparse
from pathlib import Path

from experiments.pages import RESULTS, table, write_page
from experiments.roster import COLORS
from experiments.run_comparison import band, read_run, steps_to
from openjax.commands.command_line import run_command
from openjax.files import read_json
from openjax.store.settings_files import write_json

RATES = (0.5, 0.9, 0.95)
METHOD_RUNS = RESULTS / "method_runs.json"
# On its training tasks, the paper says of its figure: OPEN needs less than half of MAPPO's samples, and MAPPO reaches .90
# with more than two billion.
PAPER = (
    "the paper's MAPPO reaches .90 after more than 2,000 M; its OPEN needs less than half of MAPPO's samples"
)


def histories() -> dict[str, list[dict]]:
    """Runs by variant, those of the shipped weights."""
    open_runs = read_json(RESULTS / "h200_runs.json")
    runs = [
        {
            "variant": "OPEN",
            "command": run["settings"]["command"],
            "machine": {"commit": open_runs["commit"]} | run["settings"]["machine"],
            "steps": run["evaluations"][-1]["steps"],
            "validation": run["evaluations"],
        }
        for run in open_runs["runs"].values()
    ]
    groups: dict[str, list[dict]] = {}
    for run in runs + read_json(METHOD_RUNS)["runs"]:
        groups.setdefault(run["variant"], []).append(run)
    return {name: groups[name] for name in COLORS if name in groups}


def report(groups: dict[str, list[dict]]) -> list[str]:
    """The page."""
    rows = []
    for name, runs in groups.items():
        cells = []
        for rate in RATES:
            reached = [steps_to(run["validation"], rate) for run in runs]
            cells.append(", ".join("–" if steps is None else f"{steps / 1e6:.0f}" for steps in reached))
        last = [run["validation"][-1] for run in runs]
        cells.append(", ".join(f"{record['capture_rate']:.3f}" for record in last))
        cells.append(", ".join(f"{record['collision_rate']:.4f}" for record in last))
        machine = runs[0]["machine"]
        made = f"`{runs[0]['command']}`, {machine['device']}, {(machine.get('commit') or 'unknown')[:7]}"
        rows.append([name, f"{runs[0]['steps'] / 1e6:.0f}", *cells, made])
    heads = ["variant", "steps (M)", *(f"to {rate} (M)" for rate in RATES), "capture rate", "collision rate"]
    return [
        "# Learning curves",
        "",
        "`python -m experiments.learning_curves`, from the histories in h200_runs.json and method_runs.json. Each seed, on "
        "validation tasks (uniform, never a layout): environment steps until the capture rate first reaches a level, and "
        f"rates at the run's end. For comparison, {PAPER}. The commands are those of their commits: MAPPO and its variants flew "
        "under the preset `paper` as it was then, without a penalty of 5,000 for an episode's first crash (now preset `mappo`); "
        "with it, as OPEN has it, none of their seeds learns as well (ablations.md).",
        "",
        *table([*heads, "first seed's command, machine, commit"], rows),
        "",
        "![Learning curves](learning_curves.png)",
    ]


def draw(groups: dict[str, list[dict]], path: Path) -> None:
    """Mean and range over seeds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 4), layout="constrained")
    FigureCanvasAgg(figure)
    fields = ("capture_rate", "capture_step", "collision_rate")
    for axis, field in zip(figure.subplots(1, 3), fields, strict=True):
        for name, runs in groups.items():
            steps, values = band(runs, field)
            axis.plot(steps / 1e6, values.mean(axis=0), color=COLORS[name], label=name)
            low, high = values.min(axis=0), values.max(axis=0)
            axis.fill_between(steps / 1e6, low, high, color=COLORS[name], alpha=0.15, linewidth=0)
        axis.set(xlabel="environment steps (million)", ylabel=field.replace("_", " "))
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> int:
    """Read runs where given, write page and picture, print the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--commit", default="", help="of the training, where the machine had no repository")
    parser.add_argument("--out", type=Path, default=RESULTS / "learning_curves")
    options = parser.parse_args(arguments)
    if options.runs:
        runs = [read_run(path, 100) for path in options.runs]
        for run in runs:
            run["machine"]["commit"] = run["machine"].get("commit") or options.commit
            del run["layouts"]
        renewed = {run["variant"] for run in runs}
        stored = read_json(METHOD_RUNS)["runs"] if METHOD_RUNS.exists() else []
        runs += [run for run in stored if run["variant"] not in renewed]
        write_json(METHOD_RUNS, {"runs": runs})
    groups = histories()
    write_page(options.out, report(groups), groups, draw)
    return 0


if __name__ == "__main__":
    run_command(main)
