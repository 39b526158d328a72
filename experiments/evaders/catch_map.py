"""The map of what can be caught: `python -m experiments.evaders.catch_map NAME=FILE ...`.

Each FILE is what `openjax map --json FILE` wrote, by the names of `KINDS`: the whole map in an empty
arena, and maps in which one thing is taken away. Losses are means over the cells that both maps have,
which are flown from the same starts. Draws the eight small maps, and the page to move about in.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.files import read_json, write_text
from openjax.runs.map_page import map_page
from openjax.show.plots import plot_map

KINDS = {
    "empty": "nothing in the way",
    "pillars": "up to five pillars",
    "sight": "seeing 90 degrees, one metre far",
    "messages": "a fifth of the messages lost, the rest .1 s late",
}
"""Maps, and how the page calls them; the first is the one that others are compared with."""
CERTAIN = 0.95
BOUNDS = {"forced_below": "below the solid line", "planar_below": "below the dashed line"}


def study(options) -> dict:
    """The maps of all files, after those stored before."""
    data = options.out.with_suffix(".json")
    stored = read_json(data)["maps"] if data.exists() else {}
    files = dict(item.split("=", 1) for item in options.maps)
    return {"maps": stored | {name: read_json(Path(file)) for name, file in files.items()}}


def by_cell(found: Mapping) -> dict[tuple, dict]:
    """Cells of a map by number of pursuers, speed ratio and radius."""
    names = ("num_pursuers", "speed_ratio", "capture_radius")
    return {tuple(cell[name] for name in names): cell for cell in found["cells"]}


def mean_rate(cells: list[dict]) -> float | None:
    """Mean capture rate; None of no cells."""
    return float(np.mean([cell["capture_rate"] for cell in cells])) if cells else None


def rows_of(maps: Mapping) -> list[dict]:
    """A row for each size of team."""
    whole = by_cell(maps["empty"])
    rows = []
    for size in sorted({key[0] for key in whole}):
        own = {key: cell for key, cell in whole.items() if key[0] == size}
        cells = list(own.values())
        row = {"size": size, "mean": mean_rate(cells)}
        row["certain"] = sum(cell["interval"][0] >= CERTAIN for cell in cells)
        for bound in BOUNDS:
            row[bound] = mean_rate([cell for cell in cells if cell["speed_ratio"] < cell[bound]])
        for kind in list(KINDS)[1:]:
            other = by_cell(maps[kind]) if kind in maps else {}
            common = [key for key in own if key in other]
            if common:
                pairs = [other[key]["capture_rate"] - own[key]["capture_rate"] for key in common]
                row[kind] = float(np.mean(pairs))
        rows.append(row)
    return rows


def page(results: Mapping) -> Page:
    """One table by size of team."""
    columns = {
        "pursuers": "size",
        "mean over all cells": "mean:.3f",
        f"cells surely above {CERTAIN}": "certain",
        **{head: f"{bound}:.3f" for bound, head in BOUNDS.items()},
        **{kind: f"{kind}:+.3f" for kind in list(KINDS)[1:] if kind in results["maps"]},
    }
    return Page(
        "What can be caught",
        "Captures over speed ratios and capture radii.",
        Table(columns, rows_of(results["maps"])),
    )


def draw(results: Mapping, path: Path) -> None:
    """The eight small maps."""
    maps = results["maps"]
    plot_map(
        path, maps["empty"]["cells"], f"{maps['empty']['policy']}: share of chases that end caught"
    )


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "catch_map")
    parser.add_argument("maps", nargs="*", metavar="NAME=FILE")
    parser.add_argument("--page", type=Path, help="file for the page to move about in (HTML)")
    options = parser.parse_args(arguments)
    publish(options, study, page, draw)
    if options.page is not None:
        maps = read_json(options.out.with_suffix(".json"))["maps"]
        named = {KINDS[name]: maps[name] for name in KINDS if name in maps}
        write_text(options.page, map_page(named))


if __name__ == "__main__":
    run_command(main)
