"""What a run flies with, and its last stage, which keeps what validates best."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.cluster.processes import Processes
from openjax.files import read_json
from openjax.learning import build, preset
from openjax.pursuit import Pursuit
from openjax.runs.last_stage import BestPolicy, keep_best
from openjax.runs.programs import kept_programs
from openjax.runs.stages import awaits_validation
from openjax.runs.start import other_compiler, prepare
from openjax.runs.train_command import TrainCommand
from openjax.store.checkpoints import CheckpointRecord
from openjax.store.leaves import named_leaves
from openjax.store.policy_files import load_policy_file
from openjax.store.run_directory import RunDirectory

GOOD = {
    "capture_rate": 1.0,
    "capture_step": 100.0,
    "collision_rate": 0.0,
    "crash_rate": 0.0,
    "over_speed_rate": 0.0,
    "prediction_error": float("nan"),  # nothing predicts
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
    before = jax.jit(parts.policy.init)(jax.random.key(1), observation)
    policy = BestPolicy(tmp_path / "policy.npz", before, settings, {"update": 7})
    policy.save()

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

    message = keep_best(policy, learn, validate, lambda: len(updates) >= asked_after)
    assert len(updates) == min(asked_after, 10) and next(rates, None) is None
    leaves, _, notes = load_policy_file(policy.path)
    first = named_leaves(before)
    for name, leaf in leaves.items():
        np.testing.assert_allclose(leaf, first[name] + kept, atol=1e-6)
    assert (notes["update"], notes.get("analytic_updates", 0)) == (7, 5 * kept)
    assert ("not kept" in message) == (kept == 0)
    written = read_json(tmp_path / "analytic.json")
    assert written["kept"] == 5 * kept and written["validation"][0]["prediction_error"] is None


def test_a_vehicle_that_is_known_by_name_needs_no_file_in_the_run(tmp_path):
    settings = preset("quick")
    command = TrainCommand(
        vehicle=Path("brushless"), out=tmp_path / "run", devices="1", settings=settings
    )
    job, _, files = prepare(command, [], 0.0, Processes())
    files.copy_to(tmp_path)
    assert job.settings.environment.airframe == "brushless" and not any(tmp_path.iterdir())


def test_a_run_that_another_jax_goes_on_with_says_so():
    def facts(version):
        return {"machine": {"versions": {"jax": version}}}

    assert other_compiler(facts(jax.__version__)) is None
    assert other_compiler({}) is None
    assert f"JAX 0.9.1 so far; JAX {jax.__version__} rounds" in other_compiler(facts("0.9.1"))


def job_of(settings, tmp_path, **options):
    command = TrainCommand(
        out=tmp_path / "run", devices="1", compare_with="none", settings=settings, **options
    )
    return prepare(command, [], 0.0, Processes())[0]


def test_what_was_stopped_before_its_validation_is_validated_when_the_run_goes_on(tmp_path):
    def record(update, score=None):
        return CheckpointRecord(Path(f"{update:09d}"), update, score, {})

    quick = job_of(preset("quick"), tmp_path)
    assert awaits_validation(record(0), quick)
    command = dataclasses.replace(quick.command, start_from="open")
    assert not awaits_validation(record(0), dataclasses.replace(quick, command=command))
    no_first_flights = preset("quick", first_flights=dict(updates=0))
    assert not awaits_validation(record(0), job_of(no_first_flights, tmp_path))
    # one is made every ten updates, and after the last one, the fiftieth
    assert [update for update in (7, 10, 15, 50) if awaits_validation(record(update), quick)] == [
        10,
        50,
    ]
    assert not any(awaits_validation(record(update, 0.5), quick) for update in (0, 10, 50))


def test_a_program_with_a_function_of_ones_own_is_never_recalled(tmp_path):
    """Its text may have changed since it was kept, under the same name in the same
    settings.
    """
    job = job_of(preset("quick"), tmp_path)
    kept = dataclasses.replace(job, traced=tmp_path)
    assert kept_programs(kept) is not None
    game = Pursuit(
        job.settings.environment, evaders=(lambda scene, memory: (0.0 * memory[:3], memory),)
    )
    own = dataclasses.replace(kept.parts, environment=game)
    assert kept_programs(dataclasses.replace(kept, parts=own)) is None


def test_a_resumed_run_flies_as_many_episodes_of_layouts_as_it_was_asked_for(tmp_path):
    first = job_of(preset("quick"), tmp_path, layout_episodes=3)
    run = RunDirectory(tmp_path / "run")
    run.path.mkdir()
    run.write_settings(first.settings, first.facts)
    command = TrainCommand(resume=run.path, settings=first.settings)
    again, _, _ = prepare(command, [], 0.0, Processes())
    assert again.command.layout_episodes == 3
    again, _, _ = prepare(dataclasses.replace(command, layout_episodes=5), [], 0.0, Processes())
    assert again.command.layout_episodes == 5
