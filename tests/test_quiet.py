"""No command passes on what libraries say to their programmers: XLA, MuJoCo,
tensorboardX, matplotlib.

Each runs at a tiny size as a user runs it: in a process of its own, with caches that
aren't there yet, and without the suite's choice of a platform.
"""

import os
import shlex
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

TINY = (
    "--num_envs 16 --rollout_length 10 --environment.episode_length 20 --environment.time_step .01 "
    "--environment.substeps 1 --network.features 8 --network.heads 1 --predictor.units 4 "
    "--predictor.windows 4 --predictor.horizons 1 2 --mappo.minibatches 2 "
    "--generator.capacity 8 --validation_interval 1 --validation_episodes 4 "
    "--first_flights.updates 1 "
    "--total_steps 320 --layout_episodes 4 --compare_with none"
)
COMMANDS = (
    "sample_flights flights --effect rotor_drag",
    "diagnose flights --out diagnosis",
    "calibrate flights --out calibrated",
    f"train --out run {TINY}",
    "evaluate --policy run --scenario wall --episodes 2 --json evaluated.json",
    "view --policy run --scenario wall --html run.html",
    "export --policy run --format c --out exported",
    "benchmark --parts mjx --envs 2 --steps 2 --seconds 0.01",
)
"""In the order in which each needs what the one before has written."""
NOISE = ("warp", "Warning", "WARNING", "font cache", "xla", "tensorboard", "I0000", "E0000")
"""What lines of these libraries have in common."""


def test_commands_say_nothing_that_libraries_say(tmp_path):
    environment = {
        **{name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"},
        "MPLCONFIGDIR": str(tmp_path / "matplotlib"),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    for command in COMMANDS:
        done = subprocess.run(
            [sys.executable, "-m", "openjax", *shlex.split(command)],
            capture_output=True, text=True, cwd=tmp_path, env=environment,
        )  # fmt: skip
        assert done.returncode == 0, command + done.stdout + done.stderr
        assert done.stderr == "", command
        said = [word for word in NOISE if word in done.stdout]
        assert not said, f"{command}: {said} in {done.stdout}"
