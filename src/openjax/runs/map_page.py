"""The map of what can be caught as a page to move about in, for a reader who knows neither game
theory nor drones.
"""

from collections.abc import Mapping
from pathlib import Path

from openjax.show.pages import filled

SHOWN = (
    *("num_pursuers", "speed_ratio", "capture_radius", "episodes", "capture_rate", "interval"),
    *("capture_seconds", "crash_rate", "forced_below", "planar_below"),
)
"""What a page has of a cell."""


def map_page(maps: Mapping[str, dict]) -> str:
    """One HTML page that needs nothing else.

    Args:
      maps: what `openjax.runs.catch_map.draw_map` returns, by what was flown in a few words; the
      first is shown first.
    """
    first = next(iter(maps.values()))
    plain = [
        {"name": name, "cells": [{key: cell.get(key) for key in SHOWN} for cell in found["cells"]]}
        for name, found in maps.items()
    ]
    return filled(
        "catch_map.html.jinja",
        Path(__file__).parent,
        maps=plain,
        game=first["game"],
        policy=first["policy"],
        evaders=first["evaders"],
        episodes=first["cells"][0]["episodes"],
        machine=first["machine"]["device"],
        seconds=round(sum(found["seconds"] for found in maps.values())),
    )
