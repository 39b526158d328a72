"""Results of an evaluation: records, and tables of them."""

import math
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from openjax.show.number_tables import numbers_table

FIELDS = (
    "scenario",
    "episodes",
    "capture_rate",
    "capture_step",
    "slowest_capture_step",
    "collision_rate",
    "collision_parts",
    "crash_rate",
    "over_speed_rate",
    "prediction_error",
)
"""Fields of an evaluation's record, in this order."""


def record_of(scenario: str, episodes: int, summary: dict, extra: tuple[str, ...] = ()) -> dict:
    """A summary as a record with exactly `FIELDS` (and `extra` ones); what isn't a
    number is None.
    """
    values = {"scenario": scenario, "episodes": episodes, **summary}

    def clean(value):
        if isinstance(value, dict):
            return {name: clean(entry) for name, entry in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {name: clean(values[name]) for name in (*FIELDS, *extra)}


def results_table(title: str, rows: Sequence[dict], game: str) -> Table:
    """Records as a table, below it a sentence on the game."""
    heads = (
        "epi-\nsodes",
        "capture\nrate",
        "capture\nstep",
        "colli-\nsions",
        "pillar/drone/\nbounds",
        "crash\nrate",
        "over-\nspeed",
        "predicted\noff by, m",
    )
    table = numbers_table(title, ("scenario", *heads), caption=game)
    for row in rows:
        parts = row["collision_parts"]
        table.add_row(
            row["scenario"],
            str(row["episodes"]),
            f"{row['capture_rate']:.3f}",
            f"{row['capture_step']:.0f}",
            f"{row['collision_rate']:.4f}",
            "/".join(
                f"{parts[name]:.3f}".removeprefix("0") for name in ("pillar", "drone", "bounds")
            ),
            f"{row['crash_rate']:.3f}",
            f"{row['over_speed_rate']:.4f}",
            "–" if row["prediction_error"] is None else f"{row['prediction_error']:.4f}",
        )
    return table


def spread_table(results: Sequence[Sequence[dict]]) -> Table:
    """Mean and standard deviation over several policies' records of the same
    scenarios.
    """
    title = f"Mean ± standard deviation of {len(results)} policies"
    columns = (
        ("capture_rate", "capture rate", ".3f"),
        ("capture_step", "capture step", ".0f"),
        ("collision_rate", "collision rate", ".4f"),
        ("crash_rate", "crash rate", ".3f"),
    )
    table = numbers_table(title, ("scenario", *(label for _, label, _ in columns)))
    for rows in zip(*results, strict=True):
        values = [(np.array([row[name] for row in rows]), style) for name, _, style in columns]
        cells = [f"{value.mean():{style}} ± {value.std(ddof=1):{style}}" for value, style in values]
        table.add_row(rows[0]["scenario"], *cells)
    return table
