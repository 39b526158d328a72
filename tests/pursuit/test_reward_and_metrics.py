"""Reward and metrics against short episodes worked out by hand.

The drones hover or glide at a constant velocity (free flight, level, thrust at hover),
the evader hardly moves.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import Pursuit, PursuitSettings, RewardSettings, Task, hover_action
from openjax.pursuit.collisions import breaches, crashed

SETTINGS = PursuitSettings(
    max_pillars=1,
    min_pillars=0,
    episode_length=4,
    evader_speed=1e-5,
    start_attitude="level",
    speed_limit="none",
    physics="rigid",
    contacts=False,
    reward=RewardSettings(first_capture=20.0, smoothness=2.0, crash=7.0, first_crash=5.0),
)
STILL = ((0.0, 0.0, 0.0),) * 3
APART = ((0.5, 0.0, 0.6), (-0.5, 0.0, 0.6), (0.0, 0.5, 0.6))


def task(pursuers, evader, pillar=None):
    return Task(
        pursuer_position=jnp.asarray(pursuers, jnp.float32),
        evader_position=jnp.asarray(evader, jnp.float32),
        pillar_position=jnp.asarray([pillar or (0.0, 0.0)], jnp.float32),
        pillar_active=jnp.array([pillar is not None]),
    )


@pytest.fixture(scope="module")
def play():
    """(task, velocities (N, 3), actions (4, N, 4)) -> end state, rewards (4, N),
    infos.
    """
    environment = Pursuit(SETTINGS)

    @jax.jit
    def run(task, velocity, actions):
        _, state = environment.reset_to(jax.random.key(0), task)
        state = state.replace(drones=state.drones.replace(velocity=velocity))

        def one(state, action):
            _, state, reward, _, _, info = environment.step(jax.random.key(0), state, action)
            return state, (reward, info)

        state, (reward, info) = jax.lax.scan(one, state, actions)
        return state, reward, info

    def call(task, velocity=STILL, change=0.0):
        hover = jnp.broadcast_to(hover_action(environment.vehicle), (4, 3, 4))
        actions = hover.at[2:, :, 3].add(change)  # yaw from the third step on
        state, reward, info = run(task, jnp.asarray(velocity, jnp.float32), actions)
        return jax.tree.map(np.asarray, (state.statistics, reward, info))

    return call


def test_capture_bounds_pillar_and_speed(play):
    # pursuer 0 comes within 0.3 m in step 2; 1 is too fast and leaves the arena in step
    # 3; 2 nears the pillar in step 4
    start = [(0.315, 0, 0.6), (0, 0.85, 0.6), (-0.4625, 0, 0.6)]
    statistics, reward, info = play(
        task(start, (0, 0, 0.6), (-0.65, 0)), [(-1, 0, 0), (0, 2, 0), (-0.5, 0, 0)], change=0.1
    )
    distance = np.array(
        [[0.305, 0.295, 0.285, 0.275], [0.87, 0.89, 0.91, 0.93], [0.4675, 0.4725, 0.4775, 0.4825]]
    ).T
    smooth = 2 * np.exp(-np.array([0, 0, 0.1, 0]))[:, None]
    penalty = np.array([[0, -10, 0], [0, -10, 0], [0, -20, 0], [0, -20, -10]])
    capture = np.array([[0], [26], [6], [6]])
    expected = capture - 0.1 * distance + smooth + penalty
    np.testing.assert_allclose(info.penalty, penalty, atol=1e-5)
    np.testing.assert_allclose(reward, expected, atol=1e-4)
    assert info.captured.any(axis=1).tolist() == [False, True, True, True]
    assert not info.captured[:, 1:].any()
    assert statistics.captured and statistics.capture_step == 2 and statistics.steps == 4
    parts = statistics.pillar_steps, statistics.drone_steps, statistics.bounds_steps
    assert [int(part) for part in parts] == [1, 0, 2]
    assert statistics.collision_rate == 0.5 and statistics.over_speed_rate == 1.0
    assert not statistics.crashed
    np.testing.assert_allclose(statistics.episode_return, expected.mean(axis=1).sum(), rtol=1e-5)


def test_no_capture_through_a_pillar(play):
    hidden = [(0.28, 0, 0.6), (0, -0.6, 0.6), (-0.5, 0, 0.6)]
    statistics, reward, info = play(task(hidden, (0, 0, 0.6), (0.12, 0)))
    assert info.seen.all() and not info.captured.any()
    assert not statistics.captured and statistics.capture_step == 4
    np.testing.assert_allclose(
        reward[:, 0], 2 - 0.028 - 10, atol=1e-4
    )  # the pillar's surface is 0.06 m away
    assert statistics.pillar_steps == 4 and statistics.collision_rate == 1.0


def test_drones_too_close_and_touching(play):
    near = [(0.5, 0, 0.6), (0.5, 0.12, 0.6), (-0.5, 0, 0.6)]
    statistics, reward, info = play(task(near, (0, 0, 0.6)))
    assert statistics.drone_steps == 4 and not statistics.crashed
    np.testing.assert_array_equal(info.breaches.drone, [[1, 1, 0]] * 4)
    np.testing.assert_allclose(
        reward[0], 2 - 0.1 * np.array([0.5, np.hypot(0.5, 0.12), 0.5]) - [10, 10, 0], atol=1e-4
    )
    touching = [(0.5, 0, 0.6), (0.5, 0.095, 0.6), (-0.5, 0, 0.6)]
    statistics, _, info = play(task(touching, (0, 0, 0.6)))
    assert statistics.crashed
    np.testing.assert_allclose(info.penalty, [[-22, -22, 0]] + [[-17, -17, 0]] * 3, atol=1e-5)


def test_every_breach_counts():
    position = jnp.array([[0.0, 0.0, 1.25], [0.0, 0.13, 1.15], [0.85, 0.4, 0.5]])
    pillars = jnp.array([[0.15, 0.0], [-0.15, 0.0], [0.0, -0.1]])
    counted = breaches(PursuitSettings(), position, pillars, jnp.array([True, True, False]))
    np.testing.assert_array_equal(counted.pillar, [2, 0, 0])
    np.testing.assert_array_equal(
        counted.drone, [0, 0, 0]
    )  # 0.164 m apart in space, 0.13 from above
    np.testing.assert_array_equal(counted.bounds, [1, 0, 1])
    np.testing.assert_array_equal(counted.total, [3, 0, 1])
    wider = breaches(
        PursuitSettings(), position, pillars, jnp.array([True, True, False]), margin=0.06
    )
    np.testing.assert_array_equal(wider.total, [4, 4, 1])


def test_crashes():
    position = jnp.array(
        [[0.5, 0, 0.05], [0.5, 0, 0.07], [-0.5, 0, 0.6], [-0.5, 0.5, 0.6], [0, -0.151, 0.5]]
    )
    up = jnp.array([1.0, 1.0, -0.01, 0.01, 1.0])
    pillars = jnp.array([[0.0, 0.0]])
    apart = position.at[1, 0].set(0.2)
    crash = crashed(PursuitSettings(), apart, up, pillars, jnp.ones(1, bool))
    np.testing.assert_array_equal(
        crash, [True, False, True, False, True]
    )  # floor, -, tilt, -, pillar
    crash = crashed(PursuitSettings(), position, up, pillars, jnp.zeros(1, bool))
    np.testing.assert_array_equal(
        crash, [True, True, True, False, False]
    )  # the first two touch each other


def test_margin_widens_the_reward_only():
    weights = RewardSettings(crash=7.0, first_crash=5.0, margin=0.02)
    environment = Pursuit(dataclasses.replace(SETTINGS, reward=weights))

    @jax.jit
    def first_step(task):
        _, state = environment.reset_to(jax.random.key(0), task)
        hover = jnp.broadcast_to(hover_action(environment.vehicle), (3, 4))
        _, state, _, _, _, info = environment.step(jax.random.key(0), state, hover)
        return info.penalty, state.statistics

    penalty, statistics = first_step(
        task([(0.5, 0, 0.6), (0.5, 0.15, 0.6), (-0.5, 0, 0.6)], (0, 0, 0.6))
    )
    assert penalty.tolist() == [-10, -10, 0] and statistics.collision_rate == 0
    penalty, statistics = first_step(
        task([(0.5, 0, 0.6), (0.5, 0.11, 0.6), (-0.5, 0, 0.6)], (0, 0, 0.6))
    )
    assert (
        penalty.tolist() == [-17, -17, 0] and not statistics.crashed
    )  # an early crash is no first one


def test_lookahead_counts_in_the_reward_what_comes_at_the_present_velocity():
    reward = dataclasses.replace(SETTINGS.reward, lookahead=0.5)
    environment = Pursuit(dataclasses.replace(SETTINGS, reward=reward))
    plain = Pursuit(SETTINGS)
    _, state = jax.jit(environment.reset)(jax.random.key(0))
    position = jnp.array([[0.55, 0.0, 0.6], [-0.5, 0.0, 0.6], [0.0, 0.5, 0.3]])
    velocity = jnp.array(
        [[0.8, 0.0, 0.0], [0.8, 0.0, 0.0], [0.0, 0.0, 0.0]]
    )  # towards the wall; inwards; still
    drones = state.drones.replace(position=position, velocity=velocity)
    pillar_active = jnp.zeros_like(state.task.pillar_active)
    state = state.replace(drones=drones, task=state.task.replace(pillar_active=pillar_active))
    action = state.previous_action
    with_it, without = (
        jax.jit(game.step)(jax.random.key(0), state, action) for game in (environment, plain)
    )
    np.testing.assert_allclose(with_it[2] - without[2], [-10.0, 0.0, 0.0], atol=1e-4)
    assert not with_it[1].statistics.collision_steps.any()
