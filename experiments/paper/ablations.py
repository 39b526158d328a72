"""Which part of OPEN carries the gain? `python -m experiments.paper.ablations RUN ... [--commit HASH] [--note TEXT]`.

RUN are directories of `openjax train` that differ in seed, predictor and generator alone:

    openjax train --preset paper --seed S --validation_interval 12
        [--predictor.enabled False] [--generator.enabled False] [--generator.turn False]

Writes experiments/results/ablations.json, .md and .png: the layouts per variant, the error of the predicted next position,
and the capture rate on validation tasks against environment steps. Without RUN the last two are written again from the first.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.paper.runs import VARIANTS, by_variant, draw_band, main_effects, read_run, savings, steps_to
from experiments.paper.values import MAIN, PREDICTION, means
from experiments.table import Page, Table, facts, page_parser, write_page
from openjax.commands.command_line import run_command
from openjax.files import read_json
from openjax.pursuit import SCENARIOS
from openjax.store.settings_files import write_json

REACH = 0.95
LAYOUTS = {
    "layout": "scenario",
    "variant": "variant",
    "lowest seed": lambda row: f"{min(row['capture_rate']):.2f}",
    "capture rate": "capture_rate:.3f",
    "capture step": "capture_step:.0f",
    "collision rate": "collision_rate:.4f",
    "crash rate": "crash_rate:.3f",
    "paper: rate, step, collisions": "paper",
}
ERRORS = {
    "layout": "scenario",
    "variant": "variant",
    "predictor": "prediction_error:.4f",
    "keeping the last seen position": "last_seen_error:.4f",
    "paper, OPEN": "paper_error",
}
COLORS = dict(zip(VARIANTS, ("tab:red", "tab:blue", "tab:green", "0.3", "tab:olive"), strict=True))


def outcomes(fields: list[str]) -> list[tuple[str, int, Callable]]:
    """What the parts are judged by: name, digits, function of a run; `fields` are capture rates on validation sets."""

    def over_layouts(field, names):
        return lambda run: float(np.mean([r[field] for r in run["layouts"] if r["scenario"] in names]))

    def millions(field):
        return lambda run: (lambda s: s and s / 1e6)(steps_to(run["validation"], REACH, field))

    found = [
        (f"steps to {REACH} on validation {kind_of(name)} tasks (M)", 1, millions(name)) for name in fields
    ]
    for where, names in (("the paper's four layouts", tuple(MAIN)), ("hidden", ("hidden",))):
        for field, digits in (("capture_rate", 4), ("capture_step", 1), ("collision_rate", 5)):
            found.append((f"{field.replace('_', ' ')}, {where}", digits, over_layouts(field, names)))
    return found


def kind_of(field: str) -> str:
    """Which validation tasks a capture rate is of."""
    return "uniform" if field == "capture_rate" else field.removesuffix("capture_rate").strip("_/ ")


def layout_rows(runs: dict[str, list[dict]]) -> list[dict]:
    """Every variant on every layout: each figure's values, one per seed."""
    rows = []
    for i, layout in enumerate(SCENARIOS):
        for name, group in runs.items():
            records = [run["layouts"][i] for run in group]
            seeds = {field: [record.get(field) for record in records] for field in records[0]}
            paper = means(layout, name)
            about = {"scenario": layout, "variant": name, "paper_error": PREDICTION.get(layout)}
            shown = "{:.3f}, {}, {:.3f}".format(*paper) if paper else None
            rows.append(seeds | about | {"paper": shown})
    return rows


def steps_table(runs: dict[str, list[dict]], field: str) -> Table:
    """Environment steps that each variant needed."""
    rows = [
        {
            "variant": name,
            "seeds": ", ".join("not reached" if s is None else f"{s / 1e6:.0f}" for s in steps),
            "mean": None if None in steps else float(np.mean(steps)) / 1e6,
            "ratio": ratio,
        }
        for name, steps, ratio in savings(runs, field, REACH)
    ]
    columns = {"variant": "variant", "each seed (M)": "seeds", "mean (M)": "mean:.0f"}
    columns["against MAPPO (range over pairs of seeds)"] = "ratio"
    title = f"Environment steps to a capture rate of {REACH} on validation {kind_of(field)} tasks"
    return Table(columns, rows, title, "First evaluation that reaches it.")


def effects_table(runs: dict[str, list[dict]], fields: list[str]) -> Table:
    """What generator and predictor change in each outcome."""
    rows = []
    for label, digits, value in outcomes(fields):
        effects = main_effects(runs, value) or {}
        texts = {part: f"{mean:+.{digits}f} ± {half:.{digits}f}" for part, (mean, half) in effects.items()}
        clear = ", ".join(part for part, (mean, half) in effects.items() if abs(mean) > half)
        rows.append({"figure": label, "clear": clear or None, **texts})
    columns = {name: name for name in ("figure", "generator", "predictor", "interaction")}
    return Table(
        columns | {"beyond the interval": "clear"},
        rows,
        "Which part carries the gain",
        "The four variants as a two by two design: change with the generator on, with the predictor on (mean over both "
        "settings of the other part) and their interaction, ± half of the 95 % interval (pooled variance over seeds).",
    )


def page(stored: dict) -> Page:
    """Layouts, prediction, steps and parts."""
    runs = by_variant(stored["runs"])
    everyone = [run for group in runs.values() for run in group]
    first = everyone[0]
    seeds = ", ".join(f"{name} {len(group)}" for name, group in runs.items())
    fields = [name for name in first["validation"][0] if name.endswith("capture_rate")]
    rows = layout_rows(runs)
    shown = [row for row in rows if row["variant"] == "OPEN" or "predictor" in row["variant"]]
    title = f"Layouts (speed clamp, drawn starts, {first['layouts'][0]['episodes']} episodes per seed)"
    return Page(
        "Ablations: what generator and predictor give",
        f"{stored['note']} Trained by `{first['command']}`, the others with another seed and with `--predictor.enabled "
        "False`, `--generator.enabled False`, `--generator.turn False` as their names say. "
        f"Seeds: {seeds}. {first['settings']['total_steps'] / 1e6:.0f} M environment steps each.\n\n"
        "A step of one world is one environment step. All worlds of a run are counted, with those that fly tasks of the "
        "archive; the validation's are not. The layouts were never trained on, nor used to choose checkpoints.",
        (
            Table(
                LAYOUTS, rows, title, "Mean (standard deviation over seeds); lowest seed: its capture rate."
            ),
            Table(ERRORS, shown, "Error of the predicted next position (m)"),
            *(steps_table(runs, field) for field in fields),
            effects_table(runs, fields),
            "![Validation curves and layouts](ablations.png)",
        ),
    )


def draw(stored: dict, path: Path) -> None:
    """Training curves with their range over seeds, and the layouts as bars."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    runs = by_variant(stored["runs"])
    figure = Figure(figsize=(17, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    fields = list(next(iter(runs.values()))[0]["validation"][0])
    curves = [name for name in ("capture_rate", "far_capture_rate", "capture_step") if name in fields]
    for axis, field in zip(axes[0], curves, strict=False):
        draw_band(axis, runs, field, COLORS)
    axes[0, 0].axhline(REACH, color="black", linewidth=0.8, linestyle=":")
    axes[0, 0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    width = 0.8 / len(runs)
    for axis, field in zip(axes[1], ("capture_rate", "capture_step", "collision_rate"), strict=True):
        for j, (name, group) in enumerate(runs.items()):
            values = np.array([[row[field] for row in run["layouts"]] for run in group], float)
            place = np.arange(len(SCENARIOS)) + (j - (len(runs) - 1) / 2) * width
            axis.bar(place, values.mean(axis=0), width, color=COLORS[name], alpha=0.8)
            axis.plot(np.tile(place, len(values)), values.ravel(), ".", color="black", markersize=3)
        axis.set_xticks(np.arange(len(SCENARIOS)), list(SCENARIOS))
        axis.set_ylabel(f"{field.replace('_', ' ')} (dots: seeds)")
        axis.grid(alpha=0.3, axis="y")
    figure.savefig(path, dpi=110)


def main(arguments: list[str]) -> int:
    """Read the runs, write the three files, print the page."""
    parser = page_parser(__doc__, "ablations")
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument("--note", default="")
    options = parser.parse_args(arguments)
    data = options.out.with_suffix(".json")
    if options.runs:
        records = [read_run(path, options.episodes) for path in options.runs]
        by_variant(records)  # complains before anything is written
        about = facts(options.commit) | {"command": "python -m experiments.paper.ablations RUN ..."}
        write_json(data, {**about, "note": options.note, "runs": records})
    write_page(options.out, page, read_json(data), draw)
    return 0


if __name__ == "__main__":
    run_command(main)
