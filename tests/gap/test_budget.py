"""Numbers of the diagnosis that somebody chose, and those that decide, have budgets; no
effect is named outside its file.
"""

import ast
import re
import tomllib
from pathlib import Path

import openjax.gap
from openjax.vehicle.effects import EFFECTS

ROOM = Path(openjax.gap.__file__).parent
SOURCES = {path: path.read_text(encoding="utf-8") for path in sorted(ROOM.rglob("*.py"))}
# both may only fall; those that decide rose once, when they came out of the modules
NUMBERS = 162
DECIDING = 66


def named_numbers(source: str) -> list[str]:
    """Constants of a module, in capitals, that hold a number."""
    found = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(part, ast.Constant) and type(part.value) in (int, float)
            for part in ast.walk(node.value)
        ):
            names = [
                n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)
            ]
            found += [name for name in names if name.isupper()]
    return found


def test_named_numbers_are_within_their_budget():
    assert len([n for source in SOURCES.values() for n in named_numbers(source)]) <= NUMBERS


def test_few_numbers_decide_and_each_has_a_meaning_and_a_source():
    table = tomllib.loads((ROOM / "decision.toml").read_text(encoding="utf-8"))
    assert len(table) <= DECIDING
    assert all(set(entry) == {"value", "meaning", "source"} for entry in table.values())


def test_no_effect_is_named_outside_its_file():
    pattern = re.compile("[\"'](" + "|".join(EFFECTS) + ")\\b")
    assert not [
        (path.name, hit)
        for path, source in SOURCES.items()
        # what decides which effect acts
        if path.parent.name in ("gap", "model", "channels")
        for hit in pattern.findall(source)
    ]
