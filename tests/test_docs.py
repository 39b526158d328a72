"""The page of the effects is what their files say, and that of the flying policies what is
stored.
"""

import importlib.util
import json
from pathlib import Path

import numpy as np

from openjax.pursuit import SCENARIOS
from openjax.vehicle.effects import EFFECTS

DOCS = Path(__file__).parents[1] / "docs"


def test_page_of_the_effects_is_made_from_their_files():
    spec = importlib.util.spec_from_file_location("make_effects", DOCS / "make_effects.py")
    make_effects = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_effects)
    told = (DOCS / "effects.md").read_text(encoding="utf-8")
    assert told == make_effects.page(), "run python docs/make_effects.py"
    for name, effect in EFFECTS.items():
        assert effect.formula, f"{name}: no formula"
        assert (DOCS / "pictures" / "effects" / f"{name}.png").exists()


def test_policies_that_fly_are_as_stored():
    """Mean of the six layouts, of each policy with each kind of vehicle."""
    results = Path(__file__).parents[1] / "experiments" / "results" / "vehicles.json"
    policies = json.loads(results.read_text(encoding="utf-8"))["policies"]
    page = (DOCS / "policies_that_fly.md").read_text(encoding="utf-8")

    def mean(of_layouts, figure, digits):
        return (
            f"{np.mean([of_layouts[name][figure] for name in SCENARIOS]):.{digits}f}".removeprefix(
                "0"
            )
        )

    figures = {"capture_rate": 3, "crash_rate": 3, "over_speed_rate": 3}
    for name, of_vehicles in policies.items():
        cells = [
            " / ".join(mean(of_vehicles[vehicle], *figure) for figure in figures.items())
            for vehicle in ("nominal", "table", "family")
        ]
        assert f"| `{name}` | {' | '.join(cells)} |" in page, name
