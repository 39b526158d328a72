"""Learning curves from committed histories: `python -m experiments.paper.learning_curves [RUN ...]`.

Capture rate, capture step and collision rate on the validation tasks against environment steps: OPEN (h200_runs.json) and
the other methods as shipped, each trained under penalties with which it learns to catch (method_runs.json, in which a RUN of
`openjax.train` takes the place of those of its variant). Writes experiments/results/learning_curves.md and .png.
"""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.roster import COLORS
from experiments.table import RESULTS, Page, Table, page_parser, write_page
from openjax.commands.command_line import run_command
from openjax.errors import UserError
from openjax.files import read_json
from openjax.show.metrics import METRICS_FILE, read_metrics
from openjax.store.run_directory import open_run
from openjax.store.settings_files import write_json

RATES = (0.5, 0.9, 0.95)
METHOD_RUNS = RESULTS / "method_runs.json"
# On its training tasks, the paper says of its figure: OPEN needs less than half of MAPPO's samples, and MAPPO reaches .90
# with more than two billion.
PAPER = (
    "the paper's MAPPO reaches .90 after more than 2,000 M; its OPEN needs less than half of MAPPO's samples"
)


VARIANTS = ("OPEN", "MAPPO + predictor", "MAPPO + generator", "MAPPO", "MAPPO, one-sided tasks")
"""In the order of the paper; the last draws the paper's uniform tasks, which all have the evader on one side."""
CURVES = ("capture_rate", "capture_step", "collision_rate", "crash_rate")
"""What is kept of the validation results."""


def variant_of(settings: dict) -> str:
    """Which of `VARIANTS` plain settings make, or DACOOP."""
    if settings["network"].get("output") == "field":
        return "DACOOP"
    predictor, generator = settings["predictor"]["enabled"], settings["generator"]["enabled"]
    if not settings["generator"]["turn"]:
        if predictor or generator:
            raise UserError("one-sided tasks (--generator.turn False) are for plain MAPPO only")
        return VARIANTS[4]
    return VARIANTS[(0 if predictor else 2) if generator else (1 if predictor else 3)]


def read_run(path: Path) -> dict:
    """One run as plain values: variant, seed and validation curve.

    Raises:
      UserError: no run, no evaluations, or steps that aren't those of all its worlds.
    """
    run = open_run(path)
    stored = read_json(run.settings_file)
    settings = stored["settings"]
    per_update = settings["num_envs"] * settings["rollout_length"]
    curve = []
    for record in read_metrics(run.path / METRICS_FILE, "validation"):
        if record["steps"] != record["update"] * per_update:
            raise UserError(
                f"{path}: {record['steps']} steps after {record['update']} updates of {per_update}"
            )
        # other validation sets, where a run has them, carry a prefix
        kept = {name: value for name, value in record.items() if name.endswith(CURVES)}
        curve.append({name: record[name] for name in ("steps", "seconds")} | kept)
    if not curve:
        raise UserError(f"{path}: no evaluation in {METRICS_FILE}")
    return {
        "variant": variant_of(settings),
        "seed": settings["seed"],
        "command": stored.get("command"),
        "machine": stored.get("machine"),
        "steps": curve[-1]["steps"],
        "validation": curve,
    }


def steps_to(curve: list[dict], rate: float, field: str = "capture_rate") -> int | None:
    """Environment steps of the first evaluation that reaches `rate`; None if none does."""
    return next((record["steps"] for record in curve if record[field] >= rate), None)


def band(runs: list[dict], field: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (T,) and values (seeds, T) of a variant's validation curves, as far as all of them go.

    Runs with other intervals between evaluations are interpolated on the first one's.
    """
    end = min(run["validation"][-1]["steps"] for run in runs)
    grid = np.array([r["steps"] for r in runs[0]["validation"] if r["steps"] <= end], float)
    values = [
        np.interp(grid, [r["steps"] for r in run["validation"]], [r[field] for r in run["validation"]])
        for run in runs
    ]
    return grid, np.array(values)


def draw_band(axis: Any, runs: dict[str, list[dict]], field: str, colors: dict[str, str]) -> None:
    """Mean and range over seeds of every variant's validation curve."""
    for name, group in runs.items():
        steps, values = band(group, field)
        axis.plot(steps / 1e6, values.mean(axis=0), color=colors[name], label=name)
        low, high = values.min(axis=0), values.max(axis=0)
        axis.fill_between(steps / 1e6, low, high, color=colors[name], alpha=0.15, linewidth=0)
    axis.set(xlabel="environment steps (million)", ylabel=field.replace("_", " "))
    axis.grid(alpha=0.3)


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


def page(results: dict) -> Page:
    """Steps to each rate, rates at the end."""
    columns = {"variant": "variant", "steps (M)": "steps:.0f"}
    columns |= {f"to {rate} (M)": f"to_{rate:.0%}" for rate in RATES}
    columns |= {
        "capture rate": "capture",
        "collision rate": "collisions",
        "first seed: command, commit": "made",
    }
    rows = []
    for name, runs in results["groups"].items():
        last = [run["validation"][-1] for run in runs]
        reached = {rate: [steps_to(run["validation"], rate) for run in runs] for rate in RATES}
        commit = runs[0]["machine"].get("commit") or "unknown"
        rows.append(
            {
                "variant": name,
                "steps": runs[0]["steps"] / 1e6,
                "capture": ", ".join(f"{record['capture_rate']:.3f}" for record in last),
                "collisions": ", ".join(f"{record['collision_rate']:.4f}" for record in last),
                "made": f"`{runs[0]['command']}`, {commit[:7]}",
            }
            | {
                f"to_{rate:.0%}": ", ".join("–" if s is None else f"{s / 1e6:.0f}" for s in steps)
                for rate, steps in reached.items()
            }
        )
    return Page(
        "Learning curves",
        "Each seed, on validation tasks (uniform, never a layout): environment steps until the capture rate first reaches "
        f"a level, and rates at the run's end. For comparison, {PAPER}. MAPPO and its variants flew without a penalty for an "
        "episode's first crash (now preset `mappo`); with it none of their seeds learns as well.",
        (Table(columns, rows), "![Learning curves](learning_curves.png)"),
    )


def draw(results: dict, path: Path) -> None:
    """Mean and range over seeds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 4), layout="constrained")
    FigureCanvasAgg(figure)
    fields = ("capture_rate", "capture_step", "collision_rate")
    for axis, field in zip(figure.subplots(1, 3), fields, strict=True):
        draw_band(axis, results["groups"], field, COLORS)
    figure.axes[0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> int:
    """Read runs where given, write page and picture, print the page."""
    parser = page_parser(__doc__, "learning_curves")
    parser.add_argument("runs", nargs="*", type=Path)
    options = parser.parse_args(arguments)
    if options.runs:
        runs = [read_run(path) for path in options.runs]
        for run in runs:
            run["machine"]["commit"] = run["machine"].get("commit") or options.commit
        renewed = {run["variant"] for run in runs}
        stored = read_json(METHOD_RUNS)["runs"] if METHOD_RUNS.exists() else []
        runs += [run for run in stored if run["variant"] not in renewed]
        write_json(METHOD_RUNS, {"runs": runs})
    groups = histories()
    about = {"command": "python -m experiments.paper.learning_curves", **groups["OPEN"][0]["machine"]}
    write_page(options.out, page, {"groups": groups, **about}, draw)
    return 0


if __name__ == "__main__":
    run_command(main)
