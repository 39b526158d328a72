"""The scaling measurement: what grows in which case, what is left out, and the script at a tiny size on virtual devices."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.speed.scaling import cases
from openjax.learning import MappoSettings, TrainSettings

pytestmark = pytest.mark.slow

TINY = """
    --preset quick --environment.time_step 0.01 --environment.substeps 1
    --environment.episode_length 10 --network.features 8 --network.heads 1
    --predictor.enabled False --generator.enabled False --mappo.minibatches 2 --mappo.epochs 1
    --num_envs 8 --rollout_length 10
""".split()


def test_worlds_or_minibatches_grow_with_the_devices_and_what_cannot_be_shared_out_is_named():
    settings = TrainSettings(num_envs=320, mappo=MappoSettings(minibatches=16))
    found, left_out = cases(settings, (1, 2, 3), ("weak", "strong", "weak_batches"))
    sizes = [
        (case.kind, case.devices, case.settings.num_envs, case.settings.mappo.minibatches) for case in found
    ]
    assert sizes == [
        ("one", 1, 320, 16),
        ("weak", 2, 640, 16),
        ("weak", 3, 960, 16),
        ("strong", 2, 320, 16),
        ("weak_batches", 2, 640, 32),
    ]
    assert [reason.split(":")[0] for reason in left_out] == [
        "strong on 3 devices",
        "weak_batches on 3 devices",
    ]


def test_script_measures_one_device_and_two(tmp_path):
    flags = os.environ["XLA_FLAGS"].replace("--xla_cpu_multi_thread_eigen=false", "")
    flags += " --xla_force_host_platform_device_count=2"
    out = tmp_path / "scaling"
    options = ["--out", str(out), "--kinds", "weak", "--calls", "2", "--seconds", "600", "--commit", "abc"]
    done = subprocess.run(
        [sys.executable, "-m", "experiments.speed.scaling", *TINY, *options],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    results = json.loads(out.with_suffix(".json").read_text())
    assert results["machine"]["commit"] == "abc" and results["machine"]["device_count"] == 2
    rows = results["rows"]
    assert [(row["devices"], row["num_envs"]) for row in rows] == [(1, 8), (2, 16)]
    for row in rows:
        assert row["env_steps_per_second"] * row["seconds"] == pytest.approx(row["num_envs"] * 10)
    assert "| weak | 2 | 16 |" in out.with_suffix(".md").read_text()
