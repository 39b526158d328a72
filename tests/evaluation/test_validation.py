"""The validation tasks: the same for all runs, the far ones as far as an archive
reaches, chosen by the uniform ones.
"""

import dataclasses

import chex
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.evaluation.episodes import summarise
from openjax.evaluation.evaluator import Evaluator
from openjax.evaluation.validation import ValidationTasks, far_tasks, selection_score, uniform_tasks
from openjax.learning import TrainSettings, build
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings, RewardSettings
from openjax.pursuit.task import START_X, starts_clear

pytestmark = pytest.mark.slow

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
    pursuers = np.asarray(far.pursuer_position)
    evader = np.asarray(far.evader_position)
    reach = np.linalg.norm(pursuers[..., :2], axis=-1)
    assert reach.max() <= SETTINGS.arena_radius - 0.1 + 1e-6
    assert np.abs(pursuers[..., 2] - 0.6).max() <= 0.1 + 1e-6
    assert (reach > np.hypot(START_X[1], 0.536)).any()
    # from all sides, unlike uniform ones, and no longer with a gap between pursuers and
    # evader
    assert (evader[:, 0] > 0.2).any() and (evader[:, 0] < -0.2).any()
    between = np.sum(pursuers[..., :2] * evader[:, None, :2], axis=-1)
    assert (between > 0).any()


def test_fewer_tasks_are_the_first_of_more(far):
    chex.assert_trees_all_equal(far_tasks(SETTINGS, 3, 6), jax.tree.map(lambda leaf: leaf[:3], far))


def test_uniform_tasks_fly_as_they_would_alone():
    """The far tasks beside them change nothing that a checkpoint is chosen by, nor does
    what the reward weighs.
    """
    game = PursuitSettings(physics="rigid", episode_length=3)
    run = TrainSettings(
        environment=game,
        network=NetworkSettings(features=8, heads=2),
        predictor=PredictorSettings(units=4, windows=2, horizons=(1, 2)),
        rollout_length=3,
        restart_steps=3,
        validation_episodes=4,
    )
    environment = Pursuit(game)
    policy = build(run, environment).policy
    key = jax.random.key(1)
    parameters = jax.jit(lambda key: policy.init(key, environment.reset(key)[0]))(key)
    validation = ValidationTasks(environment, policy, run.validation_episodes)
    uniform, far = (kind.evaluation for kind in validation(parameters))
    rewarded = dataclasses.replace(
        game, max_pillars=6, reward=RewardSettings(smoothness=2.0, first_crash=5000.0, distance=3.0)
    )
    evaluator = Evaluator(Pursuit(rewarded), policy, 4)
    tasks = {"alone": uniform_tasks(game, 4, 6)}
    alone = evaluator.fly(parameters, tasks, jax.random.key(0))[0].evaluation
    together = summarise(uniform)
    by_itself = summarise(alone)
    assert abs(together.pop("episode_return") - by_itself.pop("episode_return")) > 1.0
    assert selection_score(together, 3) == pytest.approx(selection_score(by_itself, 3), abs=1e-6)
    same = uniform.statistics.replace(episode_return=alone.statistics.episode_return)
    expected = jax.tree.leaves(alone)
    for leaf, other in zip(
        jax.tree.leaves(uniform.replace(statistics=same)), expected, strict=True
    ):
        np.testing.assert_allclose(leaf, other, rtol=1e-5, atol=1e-6)
    assert not np.allclose(far.statistics.episode_return, uniform.statistics.episode_return)


LENGTH = 800
RATES = ("capture_rate", "collision_rate", "crash_rate", "over_speed_rate")
SUMMARIES = st.fixed_dictionaries(
    {name: st.floats(0, 1) for name in RATES} | {"capture_step": st.floats(1, LENGTH)}
)


@settings(deadline=None)
@given(SUMMARIES, st.sampled_from([*RATES, "capture_step"]), st.floats(1e-3, 1))
def test_what_is_better_scores_higher(summary, name, amount):
    """Captures up, anything else down: never lower, and higher by what can be told
    apart.
    """
    good = 1.0 if name == "capture_rate" else -1.0
    low, high = (1.0, LENGTH) if name == "capture_step" else (0.0, 1.0)
    better = {
        **summary,
        name: float(np.clip(summary[name] + good * amount * (high - low), low, high)),
    }
    gained = abs(better[name] - summary[name]) / (high - low)
    gain = selection_score(better, LENGTH) - selection_score(summary, LENGTH)
    assert gain >= 0.04 * gained - 1e-12 and selection_score(summary, LENGTH) <= 1.0


@settings(deadline=None)
@given(SUMMARIES, st.floats(1, LENGTH))
def test_no_capture_step_makes_up_for_many_failures(summary, step):
    """However much sooner: not for a twentieth of the captures, a tenth of the crashes,
    a hundredth of the steps breached.
    """
    for name, change in {"capture_rate": -0.05, "crash_rate": 0.1, "collision_rate": 0.01}.items():
        worse = {**summary, name: summary[name] + change, "capture_step": step}
        assert selection_score(worse, LENGTH) <= selection_score(summary, LENGTH) + 1e-9
