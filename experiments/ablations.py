"""Which part of OPEN carries the gain? `python -m experiments.ablations RUN ... [--commit HASH] [--note TEXT]`.

RUN are directories of `openjax.train` that differ in seed, predictor and generator alone:

    openjax train --preset paper --seed S --validation_interval 12
        [--predictor.enabled False] [--generator.enabled False] [--generator.turn False]

Writes experiments/results/ablations.json, .md and .png: the layouts per variant, the error of the predicted next
position, and the capture rate on validation uniform tasks against environment steps. Without RUN the last two are
written again from the first.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.headline import PAPER as PAPER_OPEN
from experiments.headline import PAPER_PREDICTION
from experiments.pages import RESULTS, spread, table, write_page
from experiments.run_comparison import VARIANTS, band, by_variant, main_effects, read_run, savings, steps_to
from openjax.commands.command_line import run_command
from openjax.files import read_json
from openjax.pursuit import SCENARIOS
from openjax.store.settings_files import write_json

REACH = 0.95
METRICS = (
    ("capture_rate", "capture rate", 3),
    ("capture_step", "capture step", 0),
    ("collision_rate", "collision rate", 4),
    ("crash_rate", "crash rate", 3),
)
# The paper's tables of the four layouts: capture rate, capture step, collision rate.
PAPER = {(layout, "OPEN"): figures for layout, figures in PAPER_OPEN.items()} | {
    ("wall", "MAPPO"): (0.817, 569, 0.010),
    ("narrow_gap", "MAPPO"): (0.917, 484, 0.039),
    ("random", "MAPPO + predictor"): (1.000, 301, 0.012),
    ("random", "MAPPO + generator"): (0.967, 477, 0.107),
    ("random", "MAPPO"): (0.783, 494, 0.168),
    ("passage", "MAPPO + predictor"): (0.886, 428, 0.013),
    ("passage", "MAPPO + generator"): (0.727, 602, 0.216),
    ("passage", "MAPPO"): (0.617, 541, 0.013),
}


def outcomes(fields: list[str]) -> list[tuple[str, int, Callable]]:
    """What the parts are judged by: name, digits, function of a run; `fields` are capture rates on validation sets."""

    def over_layouts(field, names):
        return lambda run: float(np.mean([r[field] for r in run["layouts"] if r["scenario"] in names]))

    def millions(field):
        return lambda run: (lambda s: s and s / 1e6)(steps_to(run["validation"], REACH, field))

    four = ("wall", "narrow_gap", "random", "passage")
    return [
        *(
            (f"steps to {REACH} on validation {kind_of(field)} tasks (M)", 1, millions(field))
            for field in fields
        ),
        ("capture rate, the paper's four layouts", 4, over_layouts("capture_rate", four)),
        ("capture step, the paper's four layouts", 1, over_layouts("capture_step", four)),
        ("collision rate, the paper's four layouts", 5, over_layouts("collision_rate", four)),
        ("crash rate, the paper's four layouts", 4, over_layouts("crash_rate", four)),
        ("capture rate, hidden", 4, over_layouts("capture_rate", ("hidden",))),
        ("capture step, hidden", 1, over_layouts("capture_step", ("hidden",))),
        ("collision rate, hidden", 5, over_layouts("collision_rate", ("hidden",))),
    ]


def kind_of(field: str) -> str:
    """Which validation tasks a capture rate is of."""
    return "uniform" if field == "capture_rate" else field.removesuffix("capture_rate").strip("_/ ")


def layout_lines(runs: dict[str, list[dict]]) -> list[str]:
    """Every variant on every layout."""
    rows = []
    for i, layout in enumerate(SCENARIOS):
        for name, group in runs.items():
            paper = PAPER.get((layout, name))
            cells = [spread([run["layouts"][i][f] for run in group], digits) for f, _, digits in METRICS]
            lowest = f"{min(run['layouts'][i]['capture_rate'] for run in group):.2f}"
            shown = "{:.3f}, {}, {:.3f}".format(*paper) if paper else "–"
            rows.append([layout, name, lowest, *cells, shown])
    heads = ["layout", "variant", "lowest seed", *(label for _, label, _ in METRICS)]
    return table([*heads, "paper: rate, step, collisions"], rows)


def prediction_lines(runs: dict[str, list[dict]]) -> list[str]:
    """Error of the next position per layout."""
    names = [name for name in runs if "predictor" in name or name == "OPEN"]
    rows = []
    for i, layout in enumerate(SCENARIOS):
        cells = []
        for name in names:
            for field in ("prediction_error", "last_seen_error"):
                cells.append(spread([run["layouts"][i].get(field) for run in runs[name]], 4))
        rows.append([layout, *cells, str(PAPER_PREDICTION.get(layout, "–"))])
    heads = [text for name in names for text in (name, "keeping the last seen position")]
    return table(["layout", *heads, "paper"], rows)


def steps_done(runs: list[dict]) -> str:
    """How long the runs were, and which of them stopped early."""
    planned = runs[0]["settings"]["total_steps"]
    early = [
        f"{r['variant']} seed {r['seed']} at {r['steps'] / 1e6:.0f} M" for r in runs if r["steps"] < planned
    ]
    stopped = f" Stopped before, with the learning rate still high: {', '.join(early)}." if early else ""
    return f"{planned / 1e6:.0f} M environment steps each.{stopped}"


def report(runs: dict[str, list[dict]], facts: dict) -> list[str]:
    """The whole page."""
    everyone = [run for group in runs.values() for run in group]
    machine = everyone[0]["machine"] or {}
    seeds = ", ".join(f"{name} {len(group)}" for name, group in runs.items())
    lines = [
        "# Ablations: what generator and predictor give",
        "",
        f"`{facts['command']}`; {facts['note']} Commit {facts['commit'] or 'unknown'}. Trained on one "
        f"{machine.get('device', 'device')} per run, JAX {machine.get('versions', {}).get('jax', '?')}, "
        f"{machine.get('date', '')[:10]}: `{everyone[0]['command']}`, the others with another seed and with "
        "`--predictor.enabled False`, `--generator.enabled False`, `--generator.turn False` as their names say. "
        f"Seeds: {seeds}. {steps_done(everyone)}",
        "",
        "A step of one world is one environment step. All worlds of a run are counted, with those that fly tasks of "
        "the archive: the generator tells a task's success rate from the very episodes that train the policy and "
        "flies none beside them. The validation results are not counted, in no variant.",
        "",
        f"## Layouts (speed clamp, drawn starts, {everyone[0]['layouts'][0]['episodes']} episodes per seed)",
        "",
        "Mean (standard deviation over seeds); lowest seed: its capture rate. Never trained on, nor used to choose "
        "checkpoints.",
        "",
        *layout_lines(runs),
        "",
        "## Error of the predicted next position (m)",
        "",
        *prediction_lines(runs),
    ]
    fields = [name for name in everyone[0]["validation"][0] if name.endswith("capture_rate")]
    for field in fields:
        interval = np.median(np.diff([r["steps"] for r in everyone[0]["validation"]])) / 1e6
        lines += [
            "",
            f"## Environment steps to a capture rate of {REACH} on validation {kind_of(field)} tasks",
            "",
            f"First evaluation that reaches it; there is one every {interval:.1f} M steps.",
            "",
            *table(
                ["variant", "each seed (M)", "mean (M)", "against MAPPO (range over pairs of seeds)"],
                [
                    [
                        name,
                        ", ".join("not reached" if s is None else f"{s / 1e6:.0f}" for s in steps),
                        "–" if None in steps else f"{np.mean(steps) / 1e6:.0f}",
                        ratio,
                    ]
                    for name, steps, ratio in savings(runs, field, REACH)
                ],
            ),
        ]
    rows, significant = [], []
    for label, digits, value in outcomes(fields):
        effects = main_effects(runs, value)
        if effects is None:
            rows.append([label, "–", "–", "–"])
            continue
        rows.append([label, *(f"{mean:+.{digits}f} ± {half:.{digits}f}" for mean, half in effects.values())])
        significant += [
            f"{part}: {label} {mean:+.{digits}f}"
            for part, (mean, half) in effects.items()
            if abs(mean) > half
        ]
    lines += [
        "",
        "## Which part carries the gain",
        "",
        "The four variants as a two by two design: change with the generator on, with the predictor on (mean over "
        "both settings of the other part) and their interaction, ± half of the 95 % interval (pooled variance over "
        "seeds).",
        "",
        *table(["figure", "generator", "predictor", "interaction"], rows),
        "",
        "Beyond the interval: " + ("; ".join(significant) + "." if significant else "nothing."),
    ]
    return lines


def draw(runs: dict[str, list[dict]], path: Path) -> None:
    """Training curves with their range over seeds, and the layouts as bars."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    colors = dict(zip(VARIANTS, ("tab:red", "tab:blue", "tab:green", "0.3", "tab:olive"), strict=True))
    far = all("far_capture_rate" in r for group in runs.values() for run in group for r in run["validation"])
    for axis, field, label in (
        (axes[0, 0], "capture_rate", "capture rate, validation uniform tasks"),
        (axes[0, 1], "far_capture_rate", "capture rate, validation far tasks"),
        (axes[0, 2], "capture_step", "capture step, validation uniform tasks"),
    ):
        if field.startswith("far") and not far:
            axis.set_axis_off()
            continue
        for name, group in runs.items():
            steps, values = band(group, field)
            axis.plot(steps / 1e6, values.mean(axis=0), color=colors[name], label=name)
            axis.fill_between(
                steps / 1e6,
                values.min(axis=0),
                values.max(axis=0),
                color=colors[name],
                alpha=0.15,
                linewidth=0,
            )
        axis.set(xlabel="environment steps (million)", ylabel=label)
        axis.grid(alpha=0.3)
    axes[0, 0].axhline(REACH, color="black", linewidth=0.8, linestyle=":")
    axes[0, 0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    width = 0.8 / len(runs)
    for axis, field, label in (
        (axes[1, 0], "capture_rate", "capture rate"),
        (axes[1, 1], "capture_step", "capture step"),
        (axes[1, 2], "collision_rate", "collision rate"),
    ):
        for j, (name, group) in enumerate(runs.items()):
            values = np.array([[row[field] for row in run["layouts"]] for run in group], float)
            place = np.arange(len(SCENARIOS)) + (j - (len(runs) - 1) / 2) * width
            axis.bar(place, values.mean(axis=0), width, color=colors[name], alpha=0.8)
            for seed in values:
                axis.plot(place, seed, ".", color="black", markersize=3)
        axis.set_xticks(np.arange(len(SCENARIOS)), list(SCENARIOS))
        axis.set_ylabel(f"{label} (dots: seeds)")
        axis.grid(alpha=0.3, axis="y")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments: list[str]) -> int:
    """Read the runs, write the three files, print the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=100, help="per layout")
    parser.add_argument("--note", default="")
    parser.add_argument("--commit", default="", help="of the training, where the machine had no repository")
    parser.add_argument("--out", type=Path, default=RESULTS / "ablations")
    options = parser.parse_args(arguments)
    data = options.out.with_suffix(".json")
    if options.runs:
        records = [read_run(path, options.episodes) for path in options.runs]
        by_variant(records)  # complains before anything is written
        command = "python -m experiments.ablations RUN ..."
        facts = {"command": command, "note": options.note, "commit": options.commit}
        write_json(data, {**facts, "runs": records})
    stored = read_json(data)
    runs = by_variant(stored["runs"])
    write_page(options.out, report(runs, stored), runs, draw)
    return 0


if __name__ == "__main__":
    run_command(main)
