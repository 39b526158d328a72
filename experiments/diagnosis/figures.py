"""Figures of diagnosed cases, as `development` writes them: counts, calibration, bounds of the
shares, seconds.
"""

import math

import numpy as np

from experiments.table import Table, table
from openjax.evaluation.episodes import wilson

# figure -> what it says
FIGURES = {
    "first": "one cause: first name right",
    "nothing_else": "one cause: nothing else named",
    "false_unknown": "a named effect acts: called unknown",
    "none": "none: nothing named",
    "not_testable": "not testable: nothing named",
    "pairs": "two causes: both, nothing else",
    "unknown": "unknown: called unknown",
    "wrong_name": "unknown: a wrong name",
    "garbage": "contradictory logs: refused",
    "refused": "good logs: refused",
    "traceback": "tracebacks",
    "real": "real: first name as expected",
    "coverage": "90 % intervals that hold the truth",
    "shares": "shares add up, in bounds, intervals ordered",
    "rules": "reports without a contradiction",
    "calibration": "calibration error of the top class",
    "seconds": "seconds a case after the first, median",
    "seconds_first": "seconds of a process' first case, median",
}


def calibration_error(pairs: list, bins: int = 10) -> float:
    """Expected calibration error of (stated probability, whether true): nan without data."""
    if not pairs:
        return math.nan
    p, hit = np.array(pairs, float).T
    slot = np.minimum((p * bins).astype(int), bins - 1)
    return sum(abs((hit - p)[slot == i].sum()) for i in range(bins)) / len(p)


def shares_in_bounds(shares: dict) -> bool:
    """Whether effects, sensors and unexplained add up to 1, each within -.2 to 1.2, with intervals
    in order.
    """
    parts = [*shares["effects"].values(), shares["sensors"], shares["unexplained"]]
    values = [p["value"] for p in parts]
    intervals = [(*p["interval90"], p["value"]) for p in parts if p.get("interval90")]
    ordered = all(low <= value <= high for low, high, value in intervals)
    return ordered and abs(sum(values) - 1) < 0.02 and all(-0.2 <= v <= 1.2 for v in values)


def figures(lines: list[dict]) -> dict[str, tuple[int, int] | float]:
    """Figure -> (hits, n), or a number."""

    def of(*categories):
        return [r for r in lines if r["category"] in categories]

    def count(rows, key):
        return sum(bool(key(r)) for r in rows), len(rows)

    good = [r for r in lines if r["category"] != "garbage"]
    named = [r for r in lines if r["category"] in ("single", "pair")]
    real = [r for r in of("real") if r["truth"]]
    out = {k: count(of(c), lambda r: r["right"]) for k, c in CATEGORIES.items()}
    out |= {
        "nothing_else": count(of("single"), lambda r: not r["wrong_names"]),
        "false_unknown": count(named, lambda r: "unknown" in r["words"]),
        "wrong_name": count(of("unknown"), lambda r: r["wrong_names"]),
        "refused": count(good, lambda r: "garbage" in r["words"] and not r["traceback"]),
        "traceback": count(lines, lambda r: r["traceback"]),
        "real": count(real, lambda r: r["right"]),
        "coverage": count(
            [c for r in named for m in r.get("magnitudes", ()) for c in m["covered"]], bool
        ),
        "rules": count(
            [r for r in lines if "broken_rules" in r and "shares" in r],
            lambda r: not r["broken_rules"],
        ),
        "shares": count(
            [r for r in lines if "shares" in r], lambda r: shares_in_bounds(r["shares"])
        ),
        "calibration": calibration_error(
            [r["top"] for r in good if r["top"] and r["category"] != "real"]
        ),
        "seconds": _median(r["seconds"] for r in lines if not r["first"]),
        "seconds_first": _median(r["seconds"] for r in lines if r["first"]),
    }
    return out


CATEGORIES = {c: c for c in ("none", "not_testable", "unknown", "garbage")}
CATEGORIES |= {"first": "single", "pairs": "pair"}
"""Of the figures that say how often a category's answers are right."""


def cell(value: tuple[int, int] | float) -> str:
    """A figure as text: counts with their 95 % interval."""
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.2f}"
    hits, n = value
    if not n:
        return "–"
    low, high = wilson(hits, n)
    return f"{hits}/{n} [{low:.2f}, {high:.2f}]"


def figures_table(lines: list[dict]) -> list[str]:
    """A Markdown table, a column for each set."""
    sets = sorted({r["set"] for r in lines})
    found = [figures([r for r in lines if r["set"] == s]) for s in sets]
    rows = [[what, *(cell(f[key]) for f in found)] for key, what in FIGURES.items()]
    return table(["figure", *sets], [row for row in rows if set(row[1:]) != {"–"}])


SHOWN = (
    "first", "nothing_else", "false_unknown", "none", "pairs", "unknown", "wrong_name", "garbage",
    "coverage", "calibration",
)  # fmt: skip
"""What stands on the page of results; `--report` prints the rest."""


def shown(lines: list[dict]) -> Table:
    """The page's table: counts, a column for each set."""
    sets = sorted({r["set"] for r in lines})
    found = {s: figures([r for r in lines if r["set"] == s]) for s in sets}
    rows = []
    for key in SHOWN:
        cells = {s: cell(f[key]).partition(" ")[0] for s, f in found.items()}
        rows.append({"figure": FIGURES[key], **cells})
    return Table({name: name for name in ("figure", *sets)}, rows)


def misses(lines: list[dict]) -> list[str]:
    """One line for each case that isn't right, or that names more."""
    out = []
    for r in sorted(lines, key=lambda r: (r["set"], r["case"])):
        if r["right"] and not r["wrong_names"]:
            continue
        said = "+".join(r["words"]) or "none"
        why = r["error"] or (r["traceback"] or "").strip()[-160:]
        true = "+".join(r["truth"]) or "none"
        out.append(f"* {r['set']}/{r['case']} {r['category']}: {true} → {said} {why}")
    return out


def _median(values) -> float:
    values = list(values)
    return float(np.median(values)) if values else math.nan
