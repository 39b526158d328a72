"""The paper's main table (`tab:main`): `python -m experiments.tab_main`, from what tables.py stored.

Six methods on four layouts: capture rate, capture step, collision rate, and crash rate beside them; the paper's values
beside ours. Writes experiments/results/tab_main.md.
"""

import functools

import numpy as np

from experiments.pages import page_from_tables, spread, table, where
from experiments.roster import METHODS
from openjax.commands.command_line import run_command

FIGURES = {"capture_rate": 3, "capture_step": 0, "collision_rate": 4, "crash_rate": 3}
# mean (standard deviation) of capture rate, capture step, collision rate
PAPER = {
    "wall": {
        "Angelani": ("0.008 (0.003)", "798.0 (0.8)", "0.010 (0.000)"),
        "Janosov": ("0.009 (0.002)", "797.0 (0.8)", "0.010 (0.000)"),
        "APF": ("0.010 (0.005)", "797.0 (1.4)", "0.010 (0.000)"),
        "DACOOP": ("0.205 (0.007)", "744.0 (9.1)", "0.040 (0.008)"),
        "MAPPO": ("0.817 (0.095)", "569.1 (46.9)", "0.010 (0.076)"),
        "OPEN": ("0.987 (0.019)", "480.4 (52.4)", "0.000 (0.000)"),
    },
    "narrow_gap": {
        "Angelani": ("0.213 (0.012)", "755.0 (4.5)", "0.094 (0.001)"),
        "Janosov": ("0.219 (0.012)", "757.7 (4.2)", "0.077 (0.001)"),
        "APF": ("0.253 (0.012)", "743.0 (2.2)", "0.085 (0.000)"),
        "DACOOP": ("0.447 (0.017)", "553.0 (2.2)", "0.039 (0.002)"),
        "MAPPO": ("0.917 (0.034)", "484.0 (41.2)", "0.039 (0.032)"),
        "OPEN": ("1.000 (0.000)", "526.0 (32.9)", "0.017 (0.024)"),
    },
    "random": {
        "Angelani": ("0.277 (0.002)", "639.0 (1.6)", "0.015 (0.001)"),
        "Janosov": ("0.145 (0.019)", "716.0 (12.0)", "0.018 (0.002)"),
        "APF": ("0.314 (0.018)", "620.0 (14.8)", "0.022 (0.002)"),
        "DACOOP": ("0.563 (0.016)", "488.7 (8.7)", "0.020 (0.000)"),
        "MAPPO": ("0.783 (0.272)", "493.8 (183.6)", "0.168 (0.160)"),
        "OPEN": ("1.000 (0.000)", "329.9 (60.6)", "0.011 (0.008)"),
    },
    "passage": {
        "Angelani": ("0.733 (0.010)", "552.7 (5.0)", "0.000 (0.000)"),
        "Janosov": ("0.009 (0.003)", "799.3 (0.5)", "0.001 (0.000)"),
        "APF": ("0.229 (0.027)", "750.3 (7.4)", "0.001 (0.000)"),
        "DACOOP": ("0.818 (0.027)", "533.7 (8.8)", "0.001 (0.000)"),
        "MAPPO": ("0.617 (0.275)", "541.0 (144.9)", "0.013 (0.008)"),
        "OPEN": ("1.000 (0.000)", "329.6 (76.9)", "0.006 (0.008)"),
    },
}


def rows_of(flights: list[dict], method: str, condition: str, layout: str) -> list[dict]:
    """A method's records, one per seed."""
    return [
        flight["layouts"][layout]["record"]
        for flight in flights
        if flight["method"] == method and flight["condition"] == condition and layout in flight["layouts"]
    ]


def lines_of(flights: list[dict], condition: str, layouts: tuple[str, ...]) -> list[str]:
    """The table of one condition."""
    lines = []
    for layout in layouts:
        for method in METHODS:
            rows = rows_of(flights, method, condition, layout)
            if not rows:
                continue
            ours = [spread([row[name] for row in rows], digits) for name, digits in FIGURES.items()]
            paper = PAPER.get(layout, {}).get(method, ("–", "–", "–"))
            cells = [f"{own} / {theirs}" for own, theirs in zip(ours, (*paper, "–"), strict=True)]
            cells[-1] = ours[-1]
            lines.append([layout, method, *cells])
    return table(["layout", "method", *(name.replace("_", " ") for name in FIGURES)], lines)


def verdicts(flights: list[dict]) -> list[str]:
    """Where OPEN isn't above a method, and where a method is below the paper's own value of it."""
    below_open, below_paper = [], []
    for layout, of_paper in PAPER.items():
        means = {
            method: [np.mean([row[name] for row in rows]) for name in FIGURES]
            for method in METHODS
            if (rows := rows_of(flights, method, "clamp", layout))
        }
        for method, (rate, step, collisions, _) in means.items():
            if method != "OPEN" and "OPEN" in means:
                best = means["OPEN"]
                for name, better in (
                    ("capture rate", rate > best[0]),
                    ("capture step", step < best[1]),
                    ("collision rate", collisions < best[2]),
                ):
                    if better:
                        below_open.append(f"{layout}: {method} has the better {name}")
            for name, own, theirs, sign in zip(
                ("capture rate", "capture step", "collision rate"),
                (rate, step, collisions),
                of_paper[method],
                (1, -1, -1),
                strict=True,
            ):
                mean, spread_of = (float(part) for part in theirs.rstrip(")").split(" ("))
                if sign * (own - mean) < -spread_of - 5e-4:
                    below_paper.append(f"{layout}, {method}: {name} {own:.3g} against {mean:.3g}")
    return [
        "",
        "OPEN isn't better in every cell: " + "; ".join(below_open) + "."
        if below_open
        else "No method is better than OPEN in any cell.",
        "",
        "Worse than the paper's own value by more than its spread: "
        + ("; ".join(below_paper) or "none")
        + ".",
    ]


def report(results: dict) -> list[str]:
    """The page."""
    flights = results["flights"]
    lines = [
        "# The paper's main table: six methods, four layouts",
        "",
        f"{where(results)} {results['episodes']} episodes per seed and layout, drawn starts; ours / the paper's, mean "
        "(standard deviation over three seeds: of the training, or of the start attitudes where nothing was trained). "
        "`hidden` isn't in the paper. Collision rate: share of steps in which any pursuer is too near to anything; crash "
        "rate: share of episodes in which any pursuer touches something solid or tips over.",
        "",
        "## Speed clamp, as in the paper's simulator",
        "",
        *lines_of(flights, "clamp", (*PAPER, "hidden")),
        *verdicts(flights),
        "",
        "## Honest physics: no clamp",
        "",
        *lines_of(flights, "no clamp", (*PAPER, "hidden")),
    ]
    return lines


main = functools.partial(page_from_tables, __doc__, "tab_main", report)


if __name__ == "__main__":
    run_command(main)
