"""The page of the effects is what their files say."""

import importlib.util
from pathlib import Path

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
