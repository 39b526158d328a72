"""Adding an effect takes one file: nothing that flies or learns knows an effect by its
name.
"""

import ast
from pathlib import Path

import openjax
from openjax.vehicle.disturbances import DISTURBANCES
from openjax.vehicle.family import known_effects

ROOMS = "vehicle pursuit policy kernels learning baselines interfaces store show cluster".split()
OWN = {"mass", "inertia"}
"""Effects that are called after what they change, a number of every vehicle."""


def constants(tree):
    """The strings of a module that aren't docstrings or notes below a field, with their
    lines.
    """
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield node.lineno, node.value


def test_no_effects_name_stands_outside_its_file():
    package = Path(openjax.__file__).parent
    names = known_effects().keys() - OWN
    own = {package / "vehicle" / "effects" / f"{name}.py" for name in names - DISTURBANCES.keys()}
    assert all(path.is_file() for path in own)
    files = {path for room in ROOMS for path in (package / room).rglob("*.py")}
    files -= {*(package / "vehicle" / "effects").iterdir(), package / "vehicle" / "disturbances.py"}
    found = [
        f"{path.relative_to(package)}:{line}: {text}"
        for path in sorted(files)
        for line, text in constants(ast.parse(path.read_text()))
        if text.partition(".")[0] in names
    ]
    assert not found, found
