"""What stands alone can be loaded alone: the paper's ideas without physics, commands'
help without arrays.
"""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("modules", "unwanted"),
    [
        (("openjax.learning.advantages", "openjax.learning.archive", "openjax.learning.schedule"), "mujoco flax.linen"),
        (("openjax.policy.predictor", "openjax.kernels.attention"), "mujoco openjax.pursuit"),
        (("openjax.files", "openjax.ranges", "openjax.errors"), "jax numpy"),
        (("openjax.runs.training",), "orbax matplotlib tensorboardX torch PIL"),
    ],
)  # fmt: skip
def test_modules_load_without_what_they_do_not_need(modules, unwanted):
    script = f"import sys, {', '.join(modules)}; print([name for name in {unwanted.split()} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stdout + done.stderr


def test_the_packages_functions_stay_functions_whatever_was_imported():
    script = """
import importlib
import openjax, openjax.train
importlib.import_module("openjax.evaluate")
from openjax import train
assert all(callable(f) for f in (train, openjax.train, openjax.evaluate)), openjax.train
assert importlib.import_module("openjax.train").__file__.endswith("train.py")
openjax.train = len  # whoever replaces one on purpose may
assert openjax.train is len
"""
    command = [sys.executable, "-W", "error::ImportWarning", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True)
    assert not done.returncode and not done.stderr, done.stderr
