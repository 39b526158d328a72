"""The paper's tables: six methods on its layouts, its parts on layouts unlike its training, errors
of the prediction.
"""

from collections.abc import Iterable

import numpy as np

from experiments.paper.roster import METHODS, flights_of
from experiments.paper.values import MAIN, PARTS, PREDICTION
from experiments.table import Page, Table, cell

FIGURES = {
    "capture_rate": ".3f",
    "capture_step": ".0f",
    "collision_rate": ".4f",
    "crash_rate": ".3f",
}
BETTER = {"capture_rate": 1, "capture_step": -1, "collision_rate": -1}
"""Whether more of it is better, or less."""
LAYOUTS = (*MAIN, "hidden")
VARIANTS = ("OPEN", "MAPPO + predictor", "MAPPO + generator", "MAPPO")


def page(results: dict) -> Page:
    """The three tables."""
    columns = {"layout": "layout", "method": "method"}
    columns |= {name.replace("_", " "): beside_paper(name, form) for name, form in FIGURES.items()}
    prediction = {
        "layout": "layout",
        "OPEN": "prediction_error:.4f",
        "keeping the last seen position": "last_seen_error:.4f",
        "paper": lambda r: PREDICTION.get(r["layout"]),
    }
    return Page(
        "The paper's tables",
        f"{results['episodes']} episodes per seed and layout, drawn starts. A cell holds ours / "
        "the paper's, each the mean (standard deviation over three seeds: of the training, or of "
        "the start attitudes where nothing was trained). The paper has no `hidden`. Collision "
        "rate: share of steps in which any pursuer is too near to anything. Crash rate: share of "
        "episodes in which any pursuer touches something solid or tips over.",
        (
            Table(
                columns, cells(results, METHODS, "clamp", LAYOUTS), "Speed clamp, as in the paper"
            ),
            verdicts(results),
            Table(
                columns, cells(results, METHODS, "no clamp", LAYOUTS), "Honest physics: no clamp"
            ),
            Table(
                columns,
                cells(results, VARIANTS, "clamp", PARTS),
                "The paper's parts on layouts unlike its training",
                "Speed clamp. Penalties were chosen for OPEN; plain MAPPO's were chosen anew "
                "(preset `mappo`).",
            ),
            Table(
                prediction,
                cells(results, ["OPEN"], "clamp", LAYOUTS),
                "Prediction of the next position (m)",
                "Mean distance to the true one over all steps, seen or not; speed clamp.",
            ),
        ),
        captures(results),
    )


def captures(results: dict) -> Table:
    """The page's table: a row per method, ours / the paper's capture rate in each layout."""
    rows = []
    for method in METHODS:
        row = {"method": method}
        for record in cells(results, [method], "clamp", LAYOUTS):
            ours = float(np.mean(record["capture_rate"]))
            paper = f"{record['paper'][0][0]:.2f}" if record["paper"] else "–"
            row[record["layout"]] = f"{ours:.2f} / {paper}"
        rows.append(row)
    return Table({name: name for name in ("method", *LAYOUTS)}, rows)


def cells(
    results: dict, methods: Iterable[str], condition: str, layouts: Iterable[str]
) -> list[dict]:
    """By layout and method: each figure's values, one per seed, and the paper's."""
    row = []
    for layout in layouts:
        for method in methods:
            records = [
                f["layouts"][layout]["record"] for f in flights_of(results, method, condition)
            ]
            if records:
                seeds = {name: [record.get(name) for record in records] for name in records[0]}
                paper = (MAIN.get(layout, {}) | PARTS.get(layout, {})).get(method)
                row.append({**seeds, "layout": layout, "method": method, "paper": paper})
    return row


def beside_paper(figure: str, form: str):
    """A column: ours / the paper's."""

    def show(record: dict) -> str:
        ours = cell(record, f"{figure}:{form}")
        if figure not in BETTER:
            return ours
        if record["paper"] is None:
            return f"{ours} / –"
        mean, deviation = record["paper"][list(BETTER).index(figure)]
        digits = ".1f" if figure == "capture_step" else ".3f"
        return f"{ours} / {mean:{digits}} ({deviation:{digits}})"

    return show


def verdicts(results: dict) -> str:
    """Where OPEN isn't the best, and where a method is below the paper's own value of it."""
    above_open = []
    below_paper = []
    for layout in MAIN:
        records = {r["method"]: r for r in cells(results, METHODS, "clamp", [layout])}
        for i, (figure, sign) in enumerate(BETTER.items()):
            for method, record in records.items():
                ours = float(np.mean(record[figure]))
                name = figure.replace("_", " ")
                if (
                    "OPEN" in records
                    and sign * (ours - float(np.mean(records["OPEN"][figure]))) > 0
                ):
                    above_open.append(f"{layout}: {method} has the better {name}")
                mean, deviation = record["paper"][i]
                if sign * (ours - mean) < -deviation - 5e-4:
                    below_paper.append(f"{layout}, {method}: {name} {ours:.3g} against {mean:.3g}")
    best = "No method is better than OPEN in any cell."
    if above_open:
        best = f"OPEN is the best but for: {'; '.join(above_open)}."
    return f"{best} Worse than the paper's own value by more than its spread: {'; '.join(below_paper) or 'none'}."
