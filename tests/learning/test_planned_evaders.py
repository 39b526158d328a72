"""Evaders that plan: they leave who comes near, and the other worlds alone."""

import jax
import jax.numpy as jnp
import numpy as np

from openjax import make
from openjax.learning.planned_evaders import PlannedEvaders
from openjax.learning.settings import EvaderLearningSettings
from openjax.policy import NetworkSettings, PredictorSettings, make_policy
from openjax.pursuit import uniform_task

WORLDS = 8


def test_an_evader_that_plans_flies_away_from_the_pursuer_that_is_near():
    """Pursuers that hover, one .36 m beside it: any way past it is a capture."""
    environment = make(evaders=("field", "learned"), physics="rigid", min_pillars=0, max_pillars=1)
    predictor = PredictorSettings(enabled=False)
    policy = make_policy(environment, NetworkSettings(features=8, heads=1), predictor)
    how = EvaderLearningSettings(planned=0.75, plans=24, plan_every=20)
    learning = PlannedEvaders(how, environment, policy)
    side = jax.random.normal(jax.random.key(3), (WORLDS, 3)) * jnp.array([1.0, 1.0, 0.2])
    side = side / jnp.linalg.norm(side, axis=-1, keepdims=True)

    def begin(key, side, kind):
        task = uniform_task(environment.settings, key)
        evader = jnp.array([0.0, 0.0, 0.6])
        far = jnp.array([[0.0, 0.85, 0.6], [0.0, -0.85, 0.6]])
        pursuers = jnp.concatenate([(evader + 0.36 * side)[None], far])
        empty = jnp.zeros_like(task.pillar_active)
        task = task.replace(
            pillar_active=empty, evader_position=evader, pursuer_position=pursuers, evader=kind
        )
        return environment.reset_to(key, task)

    @jax.jit
    def wishes(key, kinds):
        keys = jax.random.split(key, WORLDS)
        world = jax.vmap(begin)(keys, side, kinds)
        parameters = policy.init(key, jax.tree.map(lambda leaf: leaf[0], world[0]))
        return learning.wishes(parameters, world, keys)

    kinds = jnp.array([1, 1, 1, 0, 1, 1, 1, 1])
    found = np.asarray(wishes(jax.random.key(1), kinds))
    plans = np.array([True, True, True, False, True, True, False, False])
    np.testing.assert_array_equal(np.isfinite(found).all(1), plans)
    np.testing.assert_allclose(np.linalg.norm(found[plans], axis=1), 1.0, rtol=1e-5)
    limit = np.sqrt(1.0 - (0.3 / 0.36) ** 2)  # cosine of the way that passes at .3 m
    assert (np.sum(found * np.asarray(side), axis=1)[plans] < limit).all()
