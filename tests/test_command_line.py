"""`openjax`: every command has help that needs no JAX; mistyped names are mended;
editors see the public functions.
"""

import importlib.util
import subprocess
import sys

import pytest

import openjax
from openjax.__main__ import COMMANDS, main
from openjax.errors import UserError
from openjax.vehicle.effect_names import effect_names
from openjax.vehicle.effects import EFFECTS

SCRIPT = """
import sys
from openjax.__main__ import main
try:
    main([{command!r}, "--help"])
except SystemExit as stop:
    assert not stop.code
print([name for name in ("jax", "mujoco", "flax", "scipy", "matplotlib") if name in sys.modules])
"""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_needs_no_jax(command):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(command=command)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert f"usage: openjax {command}" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_mistyped_command():
    with pytest.raises(UserError, match="did you mean train"):
        main(["trian"])


@pytest.mark.parametrize("value", ["1", "True"])
def test_64_bits_are_refused_in_one_line(value, monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", value)
    with pytest.raises(UserError, match="JAX_ENABLE_X64 is set; openjax computes in 32 bits"):
        main(["train"])


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"openjax {openjax.__version__}\n"


def test_every_command_is_told(capsys):
    assert main([]) == 0
    told = capsys.readouterr().out
    assert all(f"  {name} " in told for name in COMMANDS)


ENTRIES = ("train", "evaluate", "diagnose", "benchmark")
"""Commands that `python -m openjax.NAME` runs, too."""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_its_module(command):
    assert importlib.util.find_spec(f"openjax.commands.{command}")
    if command in ENTRIES:
        assert importlib.util.find_spec(f"openjax.{command}")


def test_names_of_effects_without_their_code():
    assert effect_names() == tuple(EFFECTS)
