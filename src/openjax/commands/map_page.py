"""The map of what can be caught as a page to move about in, for a reader who knows
neither game theory nor drones.
"""

from collections.abc import Mapping
from pathlib import Path

from openjax.commands.catch_map import cells_against
from openjax.show.pages import fill_template

SHOWN = (
    *("num_pursuers", "speed_ratio", "capture_radius", "episodes", "capture_rate", "interval"),
    *("capture_seconds", "crash_rate", "forced_below", "planar_below", "planner"),
)
"""A page's record of a cell."""
WHO = {
    "learned": "one that learned to escape from this team",
    "scripted": "one that flies by rules",
}
"""Kinds of evaders (`openjax.commands.catch_map.cells_against`), and how the page calls them."""


def map_page(maps: Mapping[str, dict]) -> str:
    """One HTML page that needs nothing else.

    Args:
      maps: what `openjax.commands.catch_map.draw_map` returns, by what was flown in a few
      words; the first is shown first.
    """
    first = next(iter(maps.values()))
    plain = []
    for name, map_ in maps.items():
        for evaders, words in WHO.items():
            cells = cells_against(map_, evaders)
            if cells:
                cells_shown = [{key: cell.get(key) for key in SHOWN} for cell in cells]
                plain.append({"name": f"{name}, {words}", "cells": cells_shown})
    return fill_template(
        "catch_map.html.jinja",
        Path(__file__).parent,
        maps=plain,
        game=first["game"],
        policy=first["policy"],
        evaders=first["evaders"],
        episodes=first["cells"][0]["episodes"],
        machine=first["machine"]["device"],
        seconds=round(sum(map_["seconds"] for map_ in maps.values())),
    )
