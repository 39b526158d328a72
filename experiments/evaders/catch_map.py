"""The map of what can be caught: `python -m experiments.evaders.catch_map NAME=FILE ...`.

Each FILE is what `openjax map --json FILE` wrote, by the names of `KINDS`: the whole map in an
empty arena, and maps in which one thing is taken away. A map may come in several files of that
name, with cells of its own in each. Losses are means over the cells that both maps have, which are
flown from the same starts. Draws the eight small maps, and the page to move about in.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.commands.catch_map import cells_against
from openjax.commands.map_page import map_page
from openjax.files import read_json, write_text
from openjax.show.plots import plot_map

KINDS = {
    "empty": "nothing in the way",
    "pillars": "up to five pillars",
    "sight": "seeing 90 degrees, one metre far",
    "messages": "a fifth of the messages lost, the rest .1 s late",
}
"""Maps, and how the page calls them; the first is the one that others are compared with."""
WHO = ("scripted", "learned", "planner")
OFTEN = 0.9
REACHES = {"reach_20": 0.2, "reach_30": 0.3, "reach_50": 0.5}
"""m, for which the fastest evader stands in the table that is caught `OFTEN`."""
BOUNDS = {"forced_below": "below the solid line", "planar_below": "below the dashed line"}


def study(options) -> dict:
    """The maps of all files, after those stored before."""
    data = options.out.with_suffix(".json")
    stored = read_json(data) if data.exists() else {}
    files = defaultdict(list)
    for item in options.maps:
        name, file = item.split("=", 1)
        files[name].append(read_json(Path(file)))
    maps = {name: whole_map(parts) for name, parts in files.items()}
    return {"maps": stored.get("maps", {}) | maps}


def whole_map(parts: list[dict]) -> dict:
    """One map of those that `openjax map` wrote of some cells each, and their seconds together; of
    all else, as the machine and how evaders learned, it holds the first one's.
    """
    cells = [cell for part in parts for cell in part["cells"]]
    seconds = sum(part["seconds"] for part in parts)
    whole = {**parts[0], "cells": list(by_cell(cells).values()), "seconds": seconds}
    return shortened(whole)


def shortened(values: Any) -> Any:
    """The same with four digits behind the point, which is more than a rate knows."""
    if isinstance(values, Mapping):
        return {name: shortened(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [shortened(value) for value in values]
    return round(values, 4) if isinstance(values, float) else values


def by_cell(cells: list[dict]) -> dict[tuple, dict]:
    """Cells of a map by number of pursuers, speed ratio and radius."""
    names = ("num_pursuers", "speed_ratio", "capture_radius")
    return {tuple(cell[name] for name in names): cell for cell in cells}


def mean_rate(cells: list[dict]) -> float | None:
    """Mean capture rate; None of no cells."""
    return float(np.mean([cell["capture_rate"] for cell in cells])) if cells else None


def fastest_caught(cells: Mapping, radius: float) -> float | None:
    """The speed ratio up to which, with this radius, the evader is caught `OFTEN` at each of a
    size's ratios; None where it is at none.
    """
    rates = {key[1]: cell["capture_rate"] for key, cell in cells.items() if key[2] == radius}
    caught = itertools.takewhile(lambda ratio: rates[ratio] >= OFTEN, sorted(rates))
    return max(caught, default=None)


def mean_difference(cells: Mapping, others: Mapping) -> float | None:
    """Mean of the capture rates of other cells less those of the same cells; None where none is in
    both.
    """
    common = [key for key in cells if key in others]
    pairs = [others[key]["capture_rate"] - cells[key]["capture_rate"] for key in common]
    return float(np.mean(pairs)) if common else None


def rows_of(results: Mapping) -> list[dict]:
    """A row for each size of team."""
    maps = results["maps"]
    flown = {who: by_cell(cells_against(maps["empty"], who)) for who in WHO}
    rows = []
    for size in sorted({key[0] for key in flown["scripted"]}):
        row = {"size": size}
        of_size = {
            who: {key: cell for key, cell in cells.items() if key[0] == size}
            for who, cells in flown.items()
        }
        for who, cells in of_size.items():
            own = list(cells.values())
            row[who] = {"mean": mean_rate(own)}
            row[who]["fastest"] = {
                name: fastest_caught(cells, reach) for name, reach in REACHES.items()
            }
            for bound in BOUNDS:
                below = [cell for cell in own if cell["speed_ratio"] < cell[bound]]
                row[who][bound] = mean_rate(below)
        row["planner"]["gain"] = mean_difference(of_size["learned"], of_size["planner"])
        for kind in list(KINDS)[1:]:
            if kind in maps:
                row[kind] = mean_difference(of_size["scripted"], by_cell(maps[kind]["cells"]))
        rows.append(row)
    return rows


def page(results: Mapping) -> Page:
    """What is caught, and what is taken away."""
    rows = rows_of(results)
    columns = {
        "pursuers": "size",
        "captures of scripted evaders": "scripted.mean:.2f",
        "of evaders that learned": "learned.mean:.2f",
        **{
            f"fastest caught, reach {reach:g} m": f"learned.fastest.{name}"
            for name, reach in REACHES.items()
        },
        **{head: f"learned.{bound}:.2f" for bound, head in BOUNDS.items()},
    }
    short = Table(columns, rows)
    losses = {"pursuers": "size", "planner less learned": "planner.gain:+.3f"}
    losses |= {kind: f"{kind}:+.3f" for kind in list(KINDS)[1:] if kind in results["maps"]}
    lost = Table(losses, rows, "What takes captures away")
    told = "Captures over speed ratios and capture radii."
    return Page("What can be caught", told, (short, lost), short)


def draw(results: Mapping, path: Path) -> None:
    """The eight small maps."""
    whole = results["maps"]["empty"]
    cells = cells_against(whole, "learned") or whole["cells"]
    title = (
        f"{whole['policy']}: share of chases that end with a capture, of an evader that "
        "learned to escape"
    )
    plot_map(path, cells, title)


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
