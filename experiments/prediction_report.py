"""Page and picture of `experiments.prediction`."""

from pathlib import Path

import numpy as np

from experiments.headline import PAPER_PREDICTION
from experiments.pages import table

SEEN, LOST, NOT_YET, ALL = 0, 1, 2, 3
PAPER = "paper: 1–5 ahead, absolute, step size 1e-4"
DEFAULT = "1–40 ahead, relative (default)"
QUESTIONS = (
    (
        "relative to where it was last seen, not in the arena",
        DEFAULT,
        "1–40 ahead, absolute",
    ),
    ("longer horizons", DEFAULT, "1–5 ahead, relative"),
    ("errors scaled, nothing from before it was first seen", DEFAULT, "squared error of all windows"),
    ("frames 40 ms apart", "spacing 4", DEFAULT),
    ("frames 80 ms apart", "spacing 8", DEFAULT),
    ("twice as many frames, 80 ms apart", "20 frames, spacing 8", "spacing 8"),
    (
        "last seen position, velocity, time since as input",
        "last seen position as input",
        DEFAULT,
    ),
    ("pillars as input", "pillars", DEFAULT),
    ("pillars, beside the last seen position", "last seen and pillars", "last seen position as input"),
    ("frames 40 ms apart, beside both", "last seen and pillars, spacing 4", "last seen and pillars"),
    (
        "half of the windows lost, beside both",
        "last seen and pillars, half of the windows lost",
        "last seen and pillars",
    ),
    (
        "pillars, where half of the windows are lost",
        "last seen and pillars, half of the windows lost",
        "last seen, half of the windows lost",
    ),
    ("128 units, beside both", "last seen and pillars, 128 units", "last seen and pillars"),
)
"""What was changed, the variant with it, the one without."""


def values_of(results: dict) -> dict[str, np.ndarray]:
    """Per variant and guess (seeds, groups, horizons, visibility) in cm; guesses have one seed."""
    values = {v["name"]: np.array(v["errors"], float) for v in results["variants"]}
    values |= {name: np.array(guess, float)[None] for name, guess in results["guesses"].items()}
    return {name: 100 * value for name, value in values.items()}


def best_variant(results: dict) -> str:
    """Of those with all horizons, the one that is nearest where the evader is lost from sight."""
    values = values_of(results)
    whole = [v["name"] for v in results["variants"] if list(v["horizons"]) == list(results["horizons"])]
    return min(whole, key=lambda name: values[name][:, 0, :, LOST].mean())


def report(results: dict) -> list[str]:
    """The page."""
    values, groups = values_of(results), results["groups"]
    milliseconds = [round(1000 * results["time_step"] * h) for h in results["horizons"]]
    machine, budget = results["machine"], results["budget"]
    worlds, held_back, episodes = results["worlds"]
    commit = results["commit"] or machine.get("commit") or "unknown"

    def cell(value):
        return "–" if np.isnan(value) else f"{value:.2f}" if value < 10 else f"{value:.1f}"

    def not_yet(value):
        return cell(value[:, 0, 0, NOT_YET].mean())

    spread = (
        max(np.nanmax(v[:, 0].std(axis=0, ddof=1)) for v in values.values() if len(v) > 1)
        if budget["seeds"] > 1
        else 0
    )
    heads = [f"{where} {ms} ms" for where in ("seen", "lost") for ms in milliseconds]
    best = best_variant(results)
    lines = [
        "# Predicting the evader: what helps where it is hidden",
        "",
        f"`{results['command']}` on {machine['device']}, JAX {machine['versions']['jax']}, commit {commit}: "
        f"{results['seconds']['whole']:.0f} s. {results['note']}".rstrip(),
        "",
        f"A fixed policy flew {worlds} training tasks (uniform ones, turned, up to 20 times expanded) with the exploration of "
        f"training. All variants learnt from these flights: {budget['updates']} updates of {budget['batch']} windows, "
        f"{budget['seeds']} seeds, step size falling to zero. Compared on {held_back} other training tasks and on {episodes} "
        "episodes of each layout, flown by the policy's mean; no layout was trained on. Distances to the true position in cm, "
        "at a time that is so far ahead, by what is known when the prediction is made: somebody sees the evader; nobody sees "
        "it any more (lost); nobody has seen it yet.",
        "",
        f"## Training tasks (lost in {100 * results['share'][0][LOST]:.1f} % of the steps, {results['lost_steps'][0]} of those "
        f"compared; not yet seen in {100 * results['share'][0][NOT_YET]:.1f} %)",
        "",
        f"Mean over seeds (standard deviation over seeds at most {spread:.2f}).",
        "",
        *table(
            ["predictor", *heads, f"not yet seen {milliseconds[0]} ms"],
            [
                [
                    name,
                    *(cell(x) for where in (SEEN, LOST) for x in value[:, 0, :, where].mean(axis=0)),
                    not_yet(value),
                ]
                for name, value in values.items()
            ],
        ),
        "",
        '"The evader\'s own rule" knows the pillars and the potential field and takes pursuers to fly straight on: no '
        "competitor but a bound on what there is to be learnt.",
        "",
        "## What each change gives",
        "",
        "Change of the distance on the training tasks; in brackets where it is within two standard errors over the seeds.",
        "",
        *table(["change", *heads], [[text, *changes] for text, changes in contrasts(values)]),
        "",
        "## Layouts",
        "",
        "Error of the next position over all steps, as the paper reports it.",
        "",
    ]
    names = [name for name in dict.fromkeys([PAPER, DEFAULT, best, *results["guesses"]]) if name in values]
    lines += table(
        ["layout", "paper", *names],
        [
            [layout, f"{100 * PAPER_PREDICTION[layout]:.1f}" if layout in PAPER_PREDICTION else "–"]
            + [cell(values[name][:, g, 0, ALL].mean()) for name in names]
            for g, layout in enumerate(groups)
        ],
    )
    longest = milliseconds[-1]
    lines += ["", f"Where it is lost from sight, {longest} ms ahead.", ""]
    names = [name for name in names if not np.isnan(values[name][:, 0, -1]).any()]
    lines += table(
        ["layout", "steps", *names],
        [
            [layout, f"{100 * results['share'][g][LOST]:.1f} %"]
            + [cell(values[name][:, g, -1, LOST].mean()) for name in names]
            for g, layout in enumerate(groups)
        ],
    )
    lines += [
        "",
        "## What the policy makes of better predictions",
        "",
        "The same policy, told other positions than its predictor's, without training anew: capture rate / capture step / "
        f"collision rate, {episodes} episodes each. The last row tells it the truth also where the evader is hidden.",
        "",
        *table(
            ["told", *groups[1:]],
            [
                [name, *("{:.2f} / {:.0f} / {:.4f}".format(*figures) for figures in outcome)]
                for name, outcome in results["told"].items()
            ],
        ),
    ]
    return lines


def contrasts(values: dict[str, np.ndarray]) -> list[tuple[str, list[str]]]:
    """Relative change by each of `QUESTIONS`, where the evader is seen and where it is lost."""
    rows = []
    for text, with_it, without in QUESTIONS:
        if with_it not in values or without not in values:
            continue
        cells = []
        for where in (SEEN, LOST):
            new, old = (values[name][:, 0, :, where] for name in (with_it, without))
            change = new.mean(axis=0) / old.mean(axis=0) - 1
            seeds = len(new)
            error = (
                np.sqrt((new.var(axis=0, ddof=1) + old.var(axis=0, ddof=1)) / seeds) if seeds > 1 else np.inf
            )
            clear = np.abs(new.mean(axis=0) - old.mean(axis=0)) > 2 * error
            for value, sure in zip(change, np.broadcast_to(clear, change.shape), strict=True):
                shown = f"{100 * value:+.0f} %"
                cells.append("–" if np.isnan(value) else shown if sure else f"({shown})")
        rows.append((text, cells))
    return rows


def draw(results: dict, path: Path) -> None:
    """Distance over the time ahead, seen and hidden."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = values_of(results)
    milliseconds = 1000 * results["time_step"] * np.array(results["horizons"])
    shown = dict.fromkeys(
        [
            PAPER,
            DEFAULT,
            "spacing 8",
            "pillars",
            "last seen position as input",
            best_variant(results),
            *results["guesses"],
        ]
    )
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axis, where, title in zip(
        figure.subplots(1, 2),
        (SEEN, LOST),
        ("seen when predicted", "lost from sight when predicted"),
        strict=True,
    ):
        for name in shown:
            if name not in values:
                continue
            style = {"linestyle": "--", "color": None} if name in results["guesses"] else {"linestyle": "-"}
            axis.plot(
                milliseconds, values[name][:, 0, :, where].mean(axis=0), marker="o", label=name, **style
            )
        axis.set(xscale="log", yscale="log", xlabel="time ahead (ms)", ylabel="distance (cm)", title=title)
        axis.set_ylim(bottom=0.01)
        axis.grid(alpha=0.3, which="both")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
