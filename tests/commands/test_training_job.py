"""The last stage of a run keeps what it learns only where that validates better."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.commands.training_job import keep_if_better
from openjax.files import read_json
from openjax.learning import build, preset
from openjax.pursuit import Pursuit
from openjax.store.policy_files import load_policy_file, save_policy_file
from openjax.store.run_directory import RunDirectory

GOOD = {
    "capture_rate": 1.0,
    "capture_step": 100.0,
    "collision_rate": 0.0,
    "crash_rate": 0.0,
    "over_speed_rate": 0.0,
}


@pytest.mark.parametrize("better", [True, False])
def test_last_stage_is_kept_where_it_validates_better(better, tmp_path):
    settings = preset("quick", network=dict(features=8, heads=1), predictor=dict(enabled=False))
    environment = Pursuit(settings.environment)
    observation = jax.eval_shape(lambda key: environment.reset(key)[0], jax.random.key(0))
    observation = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), observation)
    before = jax.jit(build(settings, environment).policy.init)(jax.random.key(1), observation)
    directory = RunDirectory(tmp_path)
    save_policy_file(directory.policy, before, settings, {"update": 7}, storage="float32")

    def learn(parameters, key):
        return jax.tree.map(lambda leaf: leaf + 1.0, parameters), [{"crashes_from_starts": 0.1}]

    crashes = iter([0.1, 0.0] if better else [0.0, 0.1])

    def validate(parameters):
        return GOOD | {"crash_rate": next(crashes)}

    message = keep_if_better(directory, learn, validate, settings)
    leaves, _, notes = load_policy_file(directory.policy)
    moved = [np.abs(np.asarray(leaf)).max() for leaf in jax.tree.leaves(leaves)]
    first = [np.abs(np.asarray(leaf)).max() for leaf in jax.tree.leaves(before)]
    assert (sum(moved) > sum(first) + 1) == better
    assert notes["update"] == 7
    assert ("not kept" in message) != better
    assert read_json(tmp_path / "analytic.json")["kept"] == better
