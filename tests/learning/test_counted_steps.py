"""What a training run counts as its environment steps."""

import jax
import pytest

from openjax.learning import (
    GeneratorSettings,
    MappoSettings,
    TrainSettings,
    build,
    make_training_step,
)
from openjax.learning.training_step import initial_carry
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings

pytestmark = pytest.mark.slow

TINY = TrainSettings(
    environment=PursuitSettings(episode_length=12, physics="rigid", history_length=3),
    network=NetworkSettings(features=8, heads=2),
    predictor=PredictorSettings(units=4, windows=2, horizons=(1, 2)),
    mappo=MappoSettings(minibatches=2),
    generator=GeneratorSettings(capacity=8, episodes_per_task=2),
    num_envs=12,
    rollout_length=4,
)


def test_a_training_step_simulates_exactly_the_steps_that_are_counted():
    """The generator flies no episodes of its own: the world's step is traced once, in a
    scan of the rollout's length over all worlds; any other use of it would be data that
    learning curves leave out.
    """
    calls = []

    class Watched(Pursuit):
        def step(self, key, state, action, wish=None):
            calls.append(key)
            return super().step(key, state, action, wish)

    environment = Watched(TINY.environment)
    parts = build(TINY, environment)
    carry = jax.eval_shape(lambda key: initial_carry(TINY, parts, key), jax.random.key(0))
    jaxpr = jax.make_jaxpr(make_training_step(TINY, parts))(carry)
    assert len(calls) == 1
    lengths = [
        (eqn.params["length"], [v.aval.shape for v in eqn.outvars])
        for eqn in jaxpr.jaxpr.eqns
        if eqn.primitive.name == "scan"
    ]
    commands = (TINY.rollout_length, TINY.num_envs, TINY.environment.num_pursuers, 4)
    assert (
        sum(length == TINY.rollout_length and commands in shapes for length, shapes in lengths) == 1
    )
    assert TINY.steps_per_update == TINY.rollout_length * TINY.num_envs
