"""Training runs for the curves: all steps are counted, variants are told apart, incomplete records are refused."""

import dataclasses
import json

import jax
import pytest

from experiments.paper.learning_curves import read_run, steps_to
from openjax.errors import UserError
from openjax.learning import GeneratorSettings, MappoSettings, TrainSettings, build, make_training_step
from openjax.learning.training_step import initial_carry
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.store.run_directory import create_run

pytestmark = pytest.mark.slow

TINY = TrainSettings(
    environment=PursuitSettings(episode_length=12, physics="rigid", history_length=3),
    network=NetworkSettings(features=8, heads=2),
    predictor=PredictorSettings(units=4, windows=2, steps=1, horizons=(1, 2)),
    mappo=MappoSettings(minibatches=2, epochs=1),
    generator=GeneratorSettings(capacity=8, episodes_per_task=2),
    num_envs=12,
    rollout_length=4,
)


def test_a_training_step_simulates_exactly_the_steps_that_are_counted():
    """The generator flies no episodes of its own: the world's step is traced once, in a scan of the rollout's length
    over all worlds; any other use of it would be data that the curves leave out."""
    calls = []

    class Watched(Pursuit):
        def step(self, key, state, action):
            calls.append(key)
            return super().step(key, state, action)

    environment = Watched(TINY.environment)
    parts = build(TINY, environment)
    carry = jax.eval_shape(lambda key: initial_carry(TINY, parts, key), jax.random.key(0))
    jaxpr = jax.make_jaxpr(make_training_step(TINY, environment))(carry)
    assert len(calls) == 1
    lengths = [
        (eqn.params["length"], [v.aval.shape for v in eqn.outvars])
        for eqn in jaxpr.jaxpr.eqns
        if eqn.primitive.name == "scan"
    ]
    commands = (TINY.rollout_length, TINY.num_envs, TINY.environment.num_pursuers, 4)
    assert sum(length == TINY.rollout_length and commands in shapes for length, shapes in lengths) == 1
    assert TINY.steps_per_update == TINY.rollout_length * TINY.num_envs


def test_a_run_is_read_with_its_variant_and_refused_if_steps_are_missing(tmp_path):
    for number, (settings, variant) in enumerate(
        [
            (TINY, "OPEN"),
            (dataclasses.replace(TINY, generator=GeneratorSettings(enabled=False)), "MAPPO + predictor"),
            (dataclasses.replace(TINY, predictor=PredictorSettings(enabled=False)), "MAPPO + generator"),
        ]
    ):
        run = create_run(tmp_path / str(number), overwrite=False)
        run.write_settings(settings, {"command": "train", "machine": {}})
        evaluation = {
            "event": "validation",
            "update": 5,
            "steps": 240,
            "seconds": 1.0,
            "capture_rate": 0.5,
            "far_capture_rate": 0.25,
            "episode_return": 3.0,
        }
        (run.path / "metrics.jsonl").write_text(
            json.dumps({"event": "train"}) + "\n" + json.dumps(evaluation)
        )
        record = read_run(run.path)
        assert record["variant"] == variant
        assert record["validation"] == [
            {"steps": 240, "seconds": 1.0, "capture_rate": 0.5, "far_capture_rate": 0.25}
        ]
    (run.path / "metrics.jsonl").write_text(json.dumps(evaluation | {"steps": 60}))
    with pytest.raises(UserError, match="60 steps after 5 updates of 48"):
        read_run(run.path)

    curve = [{"steps": 10 * i, "capture_rate": rate} for i, rate in enumerate((0.1, 0.96, 0.9, 1.0), 1)]
    assert steps_to(curve, 0.95) == 20 and steps_to(curve, 1.1) is None
