"""The validation tasks: the same for all runs, the far ones as far as an archive reaches, chosen by the uniform ones."""

import jax
import numpy as np
import pytest

from openjax.commands.evaluator import Evaluator
from openjax.commands.validation import Validation, far_tasks, uniform_tasks
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.task import START_X, starts_clear

SETTINGS = PursuitSettings()


@pytest.fixture(scope="module")
def far():
    return far_tasks(SETTINGS, 64, 6)


def test_far_tasks_are_fair_and_leave_the_box_of_the_uniform_draw(far):
    narrow = far.replace(
        pillar_position=far.pillar_position[:, :5], pillar_active=far.pillar_active[:, :5]
    )  # the sixth slot is there for the layouts alone
    assert not far.pillar_active[:, 5].any()
    assert jax.vmap(lambda task: starts_clear(SETTINGS, task))(narrow).all()
    pursuers, evader = np.asarray(far.pursuer_position), np.asarray(far.evader_position)
    reach = np.linalg.norm(pursuers[..., :2], axis=-1)
    assert reach.max() <= SETTINGS.arena_radius - 0.1 + 1e-6
    assert np.abs(pursuers[..., 2] - 0.6).max() <= 0.1 + 1e-6
    assert (reach > np.hypot(START_X[1], 0.536)).any()
    # from all sides, unlike uniform ones, and no longer with a gap between pursuers and evader
    assert (evader[:, 0] > 0.2).any() and (evader[:, 0] < -0.2).any()
    between = np.sum(pursuers[..., :2] * evader[:, None, :2], axis=-1)
    assert (between > 0).any()


def test_fewer_tasks_are_the_first_of_more(far):
    for one, first in zip(jax.tree.leaves(far_tasks(SETTINGS, 3, 6)), jax.tree.leaves(far), strict=True):
        np.testing.assert_array_equal(one, first[:3])


def test_uniform_tasks_fly_as_they_would_alone():
    """The far tasks beside them change nothing that a checkpoint is chosen by."""
    settings = PursuitSettings(physics="rigid", episode_length=3)
    environment = Pursuit(settings)
    policy = Policy.for_environment(
        environment, NetworkSettings(features=8, heads=2), PredictorSettings(units=4)
    )
    parameters = policy.init(jax.random.key(1), environment.reset(jax.random.key(0))[0])
    validation = Validation(environment, settings, policy, 4)
    uniform, far, _ = validation(parameters)
    alone, _ = Evaluator(environment, policy, 4)(parameters, uniform_tasks(settings, 4, 5), jax.random.key(0))
    for together, expected in zip(jax.tree.leaves(uniform), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(together, expected, rtol=1e-5, atol=1e-6)
    assert not np.allclose(far.statistics.episode_return, uniform.statistics.episode_return)
