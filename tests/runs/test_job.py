"""What a run flies with, and its last stage, which keeps what validates best."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.cluster.processes import Processes
from openjax.files import read_json
from openjax.learning import build, preset
from openjax.pursuit import Pursuit
from openjax.runs.last_stage import keep_best
from openjax.runs.start import other_compiler, prepare
from openjax.runs.train_command import TrainCommand
from openjax.runs.training import awaits_validation
from openjax.store.checkpoints import CheckpointRecord
from openjax.store.leaves import named_leaves
from openjax.store.policy_files import load_policy_file, save_policy_file
from openjax.store.run_directory import RunDirectory

GOOD = {
    "capture_rate": 1.0,
    "capture_step": 100.0,
    "collision_rate": 0.0,
    "crash_rate": 0.0,
    "over_speed_rate": 0.0,
}


@pytest.mark.parametrize(
    "crashes, kept, asked_after, planning_worlds",
    [
        ([0.1, 0.0, 0.05], 1, 99, 0),
        ([0.1, 0.05, 0.0], 2, 99, 0),
        ([0.0, 0.1, 0.0], 0, 99, 0),
        ([0.1, 0.05], 1, 7, 0),
        ([0.1], 0, 3, 0),
        # scripted evaders don't tell what a stage against planning ones is for
        ([0.0, 0.0, 0.01], 2, 99, 8),
        ([0.0, 0.01, 0.1], 1, 99, 8),
    ],
)
def test_last_stage_keeps_what_validates_best_and_ends_when_asked(
    crashes, kept, asked_after, planning_worlds, tmp_path
):
    small = dict(network=dict(features=8, heads=1), predictor=dict(enabled=False))
    stage = dict(analytic=dict(updates=10, look_every=5), worst_plans=dict(worlds=planning_worlds))
    settings = preset("quick", **small, **stage)
    environment = Pursuit(settings.environment)
    observation = jax.eval_shape(lambda key: environment.reset(key)[0], jax.random.key(0))
    observation = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), observation)
    parts = build(settings, environment)
    job = SimpleNamespace(settings=settings, parts=parts)
    before = jax.jit(parts.policy.init)(jax.random.key(1), observation)
    directory = RunDirectory(tmp_path)
    save_policy_file(directory.policy, before, settings, {"update": 7}, storage="float32")

    def learn(parameters, key):
        for moved in np.arange(1, 11) / 5:
            updates.append(moved)
            yield (
                jax.tree.map(lambda leaf, by=moved: leaf + by, parameters),
                {"crashes_from_starts": 0.1},
            )

    rates = iter(crashes)
    updates = []

    def validate(parameters):
        return GOOD | {"crash_rate": next(rates)}

    message = keep_best(directory, learn, validate, job, lambda: len(updates) >= asked_after)
    assert len(updates) == min(asked_after, 10) and next(rates, None) is None
    leaves, _, notes = load_policy_file(directory.policy)
    first = named_leaves(before)
    for name, leaf in leaves.items():
        np.testing.assert_allclose(leaf, first[name] + kept, atol=1e-6)
    assert (notes["update"], notes.get("analytic_updates", 0)) == (7, 5 * kept)
    assert ("not kept" in message) == (kept == 0)
    assert read_json(tmp_path / "analytic.json")["kept"] == 5 * kept


def test_a_vehicle_that_is_known_by_name_needs_no_file_in_the_run(tmp_path):
    settings = preset("quick")
    command = TrainCommand(
        vehicle=Path("brushless"), out=tmp_path / "run", devices="1", settings=settings
    )
    job, _, files = prepare(command, [], 0.0, Processes())
    assert job.settings.environment.airframe == "brushless" and files == {}


def test_a_run_that_another_jax_goes_on_with_says_so():
    def facts(version):
        return {"machine": {"versions": {"jax": version}}}

    assert other_compiler(facts(jax.__version__)) is None
    assert other_compiler({}) is None
    assert f"JAX 0.9.1 so far; JAX {jax.__version__} goes on" in other_compiler(facts("0.9.1"))


def test_a_start_that_was_never_validated_is_when_the_run_goes_on():
    settings = preset("quick")
    unscored = CheckpointRecord(Path("000000000"), 0, None, {})
    assert awaits_validation(unscored, settings, None)
    assert not awaits_validation(unscored, settings, "open")
    assert not awaits_validation(unscored, preset("quick", first_flights=dict(updates=0)), None)
    scored = CheckpointRecord(Path("000000000"), 0, 0.5, {})
    later = CheckpointRecord(Path("000000007"), 7, None, {})
    assert not any(awaits_validation(record, settings, None) for record in (scored, later))


def test_a_program_with_a_function_of_ones_own_is_never_recalled(tmp_path):
    """Its text may have changed since it was kept, under the same name in the same
    settings.
    """
    settings = preset("quick")
    command = TrainCommand(out=tmp_path / "run", devices="1", settings=settings)
    job, _, _ = prepare(command, [], 0.0, Processes())
    kept = dataclasses.replace(job, traced=tmp_path)
    assert kept.keep is not None
    game = Pursuit(
        settings.environment, evaders=(lambda scene, memory: (0.0 * memory[:3], memory),)
    )
    assert dataclasses.replace(kept, environment=game).keep is None
