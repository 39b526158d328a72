"""The compiled training step as a whole: compiles once, keeps its carry's types, resets
in turn, obeys its switches.
"""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.evaluation.episodes import make_evaluate, summarise
from openjax.learning import (
    GeneratorSettings,
    MappoSettings,
    TrainSettings,
    build,
    changed,
    make_start,
    make_training_step,
    preset,
    training_step,
)
from openjax.learning.training_step import initial_carry, make_phases, penalty_share_at
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import SCENARIOS, PursuitSettings, hover_action, scenario_task

pytestmark = pytest.mark.slow

GROUPS = 3
LENGTH = 12
ROLLOUT = 4
UPDATES = 7
SETTINGS = TrainSettings(
    environment=PursuitSettings(
        episode_length=LENGTH, physics="rigid", capture_radius=1.0, history_length=3
    ),
    network=NetworkSettings(features=8, heads=2),
    predictor=PredictorSettings(units=4, windows=2, horizons=(1, 2)),
    mappo=MappoSettings(minibatches=2, penalty_start=0.2, penalty_ramp=0.5),
    generator=GeneratorSettings(capacity=8, success_low=0.0, success_high=1.0, episodes_per_task=2),
    num_envs=12,
    rollout_length=ROLLOUT,
    total_steps=12 * ROLLOUT * 10,
)


@pytest.fixture(scope="module")
def run():
    """(start, carries after each of UPDATES steps, their metrics, the compiled step);
    carries as NumPy.
    """
    carry = make_start(SETTINGS)(jax.random.key(0))
    step = jax.jit(make_training_step(SETTINGS), donate_argnums=0)
    start = _numpy(carry)
    carries = []
    metrics = []
    donated = carry
    for _ in range(UPDATES):
        carry, watched = step(carry)
        carries.append(_numpy(carry))
        metrics.append(jax.tree.map(float, watched))
    return start, carries, metrics, step, carry, donated


def _numpy(tree):
    def copied(x):
        return np.array(
            jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        )

    return jax.tree.map(copied, tree)


def test_compiles_once_and_keeps_the_types_of_its_carry(run):
    start, carries, _, step, carry, donated = run
    assert step._cache_size() == 1
    for leaf in jax.tree.leaves(carry):
        assert isinstance(leaf, jax.Array) and not getattr(leaf, "weak_type", False)
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (start, carries[-1])]
    assert shapes[0] == shapes[1]
    # the buffers of the carry that was handed in are used again
    assert (
        donated.state.drones.position.is_deleted()
        and donated.archive.tasks.pillar_position.is_deleted()
    )


def test_metrics_are_finite_numbers(run):
    _, _, metrics, *_ = run
    expected = {
        "capture_rate",
        "collision_rate",
        "prediction_error",
        "predictor_loss",
        "entropy",
        "kl",
        "reward",
    }
    assert expected | {"archive_size", "success_rate", "episode_return"} <= set(metrics[0])
    assert all(np.isfinite(list(watched.values())).all() for watched in metrics)


def test_each_group_ends_in_its_turn_and_after_its_whole_episode(run):
    start, carries, *_ = run
    group = np.arange(SETTINGS.num_envs) % GROUPS
    np.testing.assert_array_equal(start.state.step, group * ROLLOUT)
    before = start.state
    ages = before.step.copy()
    for update, carry in enumerate(carries):
        ended = group == (GROUPS - 1 - update) % GROUPS
        np.testing.assert_array_equal(before.step[ended], LENGTH - ROLLOUT)
        np.testing.assert_array_equal(carry.state.step, np.where(ended, 0, before.step + ROLLOUT))
        np.testing.assert_array_equal(carry.state.statistics.steps[ended], 0)
        went_on = carry.state.task.evader_position[~ended] == before.task.evader_position[~ended]
        assert went_on.all()
        assert np.any(carry.state.task.evader_position[ended] != before.task.evader_position[ended])
        ages = np.where(ended, 0, ages + ROLLOUT)
        before = carry.state
    np.testing.assert_array_equal(carries[-1].state.step, ages)
    # from the first reset on, what is counted is the whole episode so far
    np.testing.assert_array_equal(carries[-1].state.statistics.steps, ages)


def test_environments_that_share_a_task_start_alike_but_for_their_attitude(run):
    start, carries, *_ = run
    for state in (start.state, carries[-1].state):
        # (place in the group, group)
        evader = state.task.evader_position.reshape(-1, GROUPS, 3)
        np.testing.assert_array_equal(evader[0::2], evader[1::2])
        assert np.any(evader[0] != evader[2])
    assert np.any(start.state.drones.quaternion[0] != start.state.drones.quaternion[GROUPS])


def test_only_whole_episodes_enter_the_archive(run):
    _, carries, metrics, *_ = run
    # the groups that started late end incomplete episodes in the first two steps; then
    # two tasks per step enter
    sizes = [int(carry.archive.size) for carry in carries]
    assert sizes == [0, 0, 2, 4, 6, 8, 8]
    assert [watched["archive_size"] for watched in metrics] == sizes
    ended = carries[1].state.task  # of group 0, whose episodes end in the third step
    entered = carries[2].archive.tasks.evader_position[:2]
    np.testing.assert_array_equal(entered[::-1], ended.evader_position[0::GROUPS][::2])


def test_what_an_update_changes(run):
    start, carries, *_ = run
    for before, after in ((start, carries[0]), (carries[0], carries[1])):
        for name in ("actor", "critic", "predictor"):
            moved = jax.tree.map(
                lambda a, b: np.any(a != b),
                getattr(before.policy, name),
                getattr(after.policy, name),
            )
            assert any(jax.tree.leaves(moved)), name
        assert np.any(before.key != after.key) and after.update == before.update + 1
    assert (
        carries[-1].learners["policy"].value_scale.weight
        > carries[0].learners["policy"].value_scale.weight
    )


def test_same_seed_same_run(run):
    _, carries, _, step, *_ = run
    carry, _ = step(make_start(SETTINGS)(jax.random.key(0)))
    chex.assert_trees_all_equal(_numpy(carry), carries[0])


@pytest.fixture
def no_learning(monkeypatch):
    """Actor and critic stay as they are: their update takes most of the compiler's
    time.
    """

    def phases_without(*arguments, **named):
        phases = make_phases(*arguments, **named)
        return dataclasses.replace(phases, learn=phases.learn[:-1])

    monkeypatch.setattr(training_step, "make_phases", phases_without)


NO_PREDICTOR = dataclasses.replace(SETTINGS.predictor, enabled=False)
NO_GENERATOR = dataclasses.replace(SETTINGS.generator, enabled=False)


def traced(settings):
    """Shapes and types of a run's carry before and after a step, and the names of the
    step's metrics.
    """
    start = functools.partial(initial_carry, settings, build(settings))
    before = jax.eval_shape(start, jax.random.key(0))
    after, metrics = jax.eval_shape(make_training_step(settings), before)
    return before, after, set(metrics)


def test_the_step_without_predictor_and_generator_keeps_its_carry():
    before, after, metrics = traced(
        dataclasses.replace(SETTINGS, predictor=NO_PREDICTOR, generator=NO_GENERATOR)
    )
    assert before == after and "entropy" in metrics
    assert not {"predictor_loss", "prediction_error"} & metrics and before.policy.predictor == {}


@pytest.mark.parametrize("generator", [SETTINGS.generator, NO_GENERATOR])
def test_the_step_with_several_evaders_keeps_its_carry_and_archives_them(generator):
    before, after, _ = traced(
        changed(
            SETTINGS,
            environment=dict(evaders=("field", "greedy", "learned")),
            generator=generator,
            evaders_start=0.1,
            evaders_ramp=0.1,
        )
    )
    assert before == after
    assert before.archive.tasks.evader.dtype == before.state.task.evader.dtype == jnp.int32


def test_without_the_generator_every_world_flies_its_own_task():
    plain = dataclasses.replace(SETTINGS, predictor=NO_PREDICTOR, generator=NO_GENERATOR)
    assert plain.episodes_per_task == 1
    evader = np.asarray(make_start(plain)(jax.random.key(0)).state.task.evader_position)
    assert len(np.unique(evader, axis=0)) == plain.num_envs


def test_penalties_ramp_up():
    share = [float(penalty_share_at(SETTINGS, progress)) for progress in (0.0, 0.2, 0.5, 0.9)]
    np.testing.assert_allclose(share, [0.2, 0.52, 1.0, 1.0], atol=1e-6)
    assert float(penalty_share_at(TrainSettings(), 0.0)) == 1.0


def test_evaluation_of_a_policy_that_hovers():
    """Drones that hover at their starts in `empty`: nothing is captured or breached,
    and the evader is always seen.
    """
    layout = dataclasses.replace(
        SCENARIOS["empty"], pursuers=((0.0, 0.5, 0.5), (0.0, 0.5, 0.62), (0.5, 0.0, 0.5))
    )
    game = PursuitSettings(
        num_pursuers=3,
        min_pillars=0,
        max_pillars=1,
        physics="rigid",
        start_attitude="level",
        episode_length=10,
    )
    settings = TrainSettings(
        environment=game, network=SETTINGS.network, predictor=SETTINGS.predictor, rollout_length=10
    )
    parts = build(settings)
    task = jax.tree.map(lambda x: jnp.stack([x, x]), scenario_task(game, layout))
    near = task.replace(
        evader_position=task.evader_position.at[1].set(jnp.array([0.5, -0.27, 0.5]))
    )

    @jax.jit
    def play(key, tasks):
        observation, _ = parts.environment.reset(key)
        parameters = parts.policy.init(key, observation)
        parameters = jax.tree_util.tree_map_with_path(
            lambda path, x: jnp.zeros_like(x) if _is_output(path) else x, parameters
        )
        return make_evaluate(parts.environment, parts.policy, trajectory=True)(
            parameters, tasks, key
        )

    evaluation, trajectory = play(jax.random.key(0), near)
    assert trajectory.pursuers.shape == (2, 10, 3, 3) and trajectory.predicted.shape == (
        2,
        10,
        2,
        3,
    )
    np.testing.assert_allclose(
        trajectory.pursuers,
        np.broadcast_to(near.pursuer_position[:, None], (2, 10, 3, 3)),
        atol=2e-3,
    )
    np.testing.assert_allclose(hover_action(parts.environment.vehicle)[1:], 0.0)
    # the predictor's output is zero: it says what keeping the last seen position says
    np.testing.assert_allclose(evaluation.last_seen_error, 0.013, rtol=1e-2)
    np.testing.assert_allclose(evaluation.prediction_error, evaluation.last_seen_error, rtol=1e-5)
    assert trajectory.captured[1, 0, 2] and not trajectory.captured[0].any()
    metrics = summarise(evaluation)
    # two drones are too close all the time; in one of two episodes the evader starts
    # within reach
    assert (metrics["capture_rate"], metrics["capture_step"]) == (0.5, 5.5)
    assert metrics["slowest_capture_step"] == 10.0
    assert metrics["collision_rate"] == 1.0 and metrics["collision_parts"] == {
        "pillar": 0.0,
        "drone": 1.0,
        "bounds": 0.0,
    }
    assert metrics["crash_rate"] == 0.0 and metrics["over_speed_rate"] == 0.0
    expected = evaluation.statistics.episode_return.mean()
    np.testing.assert_allclose(metrics["episode_return"], expected, rtol=1e-5)


def _is_output(path):
    """Leaves of the last layers' kernels, of actor and predictor."""
    text = jax.tree_util.keystr(path)
    return ("'mean'" in text or "'output'" in text) and "'kernel'" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(rollout_length=5), "rollout_length 5 must divide environment.episode_length 12"),
        (dict(num_envs=10), "num_envs 10 must be a multiple of 6"),
        (
            dict(mappo=MappoSettings(minibatches=5)),
            "num_envs 12 must be a multiple of mappo.minibatches 5",
        ),
        (
            dict(predictor=PredictorSettings(windows=4, horizons=(1, 3))),
            "do not fit into rollout_length 4",
        ),
        (dict(total_steps=0), "total_steps is 0"),
    ],
)
def test_impossible_settings(changes, message):
    with pytest.raises(UserError, match=message):
        dataclasses.replace(SETTINGS, **changes)


def test_presets():
    for name in ("quick", "paper"):
        assert preset(name, seed=3).seed == 3
    paper = preset("paper")
    dear = preset("paper", environment=dict(reward=dict(crash=55.0)))  # all else stays
    assert dear != paper and changed(dear, environment=dict(reward=dict(crash=20.0))) == paper
    with pytest.raises(UserError, match="crash"):
        preset("paper", environment=dict(reward=dict(crash=float("nan"))))
    with pytest.raises(UserError, match="papers: no such preset; did you mean paper"):
        preset("papers")


def test_the_worlds_of_every_second_task_start_anew_within_the_episode(no_learning):
    rollouts = 2
    settings = dataclasses.replace(
        SETTINGS, restart_every=2, restart_steps=rollouts * ROLLOUT, predictor=NO_PREDICTOR
    )
    carry = make_start(settings)(jax.random.key(0))
    step = jax.jit(make_training_step(settings))
    world = np.arange(settings.num_envs)
    group = world % GROUPS
    brief = world // GROUPS // settings.episodes_per_task % 2 == 0
    expected = group * ROLLOUT
    entered = 0
    for update in range(UPDATES):
        before = carry.state
        carry, _ = step(carry)
        ended = group == (GROUPS - 1 - update) % GROUPS
        age = (group + update + 1) % GROUPS  # in rollouts, since the group's start
        anew = brief & (age > 0) & (age % rollouts == 0)
        expected = np.where(ended | anew, 0, expected + ROLLOUT)
        np.testing.assert_array_equal(carry.state.step, expected)
        moved = np.any(carry.state.task.evader_position != before.task.evader_position, axis=1)
        np.testing.assert_array_equal(moved, ended | anew)
        # of the group that ended only the other task was flown to its end, unless it
        # began late
        entered += int(update >= 2)
        assert int(carry.archive.size) == min(entered, settings.generator.capacity)
