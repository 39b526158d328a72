"""Teams of different sizes in one batch: empty slots of a world change nothing in
it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax import Pursuit, PursuitSettings, UserError
from openjax.pursuit import RewardSettings, Term, default_reward, expand_task, turn_task
from openjax.pursuit.task import close_starts, scatter_starts, starts_clear, uniform_task

REWARD = RewardSettings(
    smoothness=2.0, crash=9.0, first_crash=5.0, first_capture=7.0, lookahead=0.2
)
ALONE = PursuitSettings(
    physics="rigid",
    start_attitude="level",
    evaders=("greedy", "learned"),
    history_pursuers="pooled",
    observe_game=True,
    observe_arena=True,
    reward=REWARD,
)
TEAMS = dataclasses.replace(ALONE, num_pursuers=5, team_sizes=(1, 3, 5))
drawn_task = jax.jit(uniform_task, static_argnums=0)


def flown(settings, task, actions):
    """Observations, rewards, infos and the last state of an episode's first steps."""
    game = Pursuit(settings)

    def one(carry, action):
        observation, state, reward, _, _, info = game.step(jax.random.key(0), carry, action)
        return state, (observation, reward, info)

    @jax.jit
    def fly(task):
        return jax.lax.scan(one, game.reset_to(jax.random.key(0), task)[1], actions)

    state, record = fly(task)
    return record, state


@pytest.mark.parametrize("physics", ["rigid", pytest.param("stops", marks=pytest.mark.slow)])
def test_three_of_five_fly_as_three(physics):
    """Whatever the two empty slots do: steps, what is seen, rewards and counts are
    those of three, in a narrow arena that is the game's or the task's own.
    """
    alone = dataclasses.replace(ALONE, physics=physics, arena_radius=0.55)
    task = drawn_task(ALONE, jax.random.key(3)).replace(
        evader=jnp.int32(0), evader_speed=jnp.float32(1.1), capture_radius=jnp.float32(0.55)
    )
    empty = jnp.concatenate([task.pursuer_position, task.pursuer_position[:2]])
    wider = task.replace(
        pursuer_position=empty,
        active=jnp.arange(5) < 3,
        arena_radius=jnp.float32(alone.arena_radius),
    )
    actions = 0.3 * jax.random.normal(jax.random.key(1), (40, 5, 4)) + jnp.array([0.25, 0, 0, 0])
    (seen, reward, info), end = flown(alone, task, actions[:, :3])
    teams = dataclasses.replace(ALONE, physics=physics, num_pursuers=5)
    (seen_by, reward_of, info_of), end_of = flown(teams, wider, actions)

    caught = np.any(info.captured, axis=1)
    assert caught.any() and not caught.all(), "the test shows little"
    outside = end.statistics.bounds_steps
    assert outside > 0, "the test shows little of the arena"
    np.testing.assert_allclose(reward_of[:, :3], reward, atol=1e-4)
    assert not np.any(reward_of[:, 3:])
    for name in ("self_state", "pillars", "privileged", "position"):
        np.testing.assert_allclose(
            getattr(seen_by, name)[:, :3], getattr(seen, name), atol=1e-4, err_msg=name
        )
        assert not np.any(getattr(seen_by, name)[:, 3:])
    np.testing.assert_allclose(seen_by.frames, seen.frames, atol=1e-3)
    np.testing.assert_allclose(seen_by.others[:, :3, :2], seen.others, atol=1e-4)
    assert np.all(seen_by.others[:, :3, 2:] == -5.0)
    np.testing.assert_array_equal(seen_by.others_there[0, :3], [[1, 1, 0, 0]] * 3)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), end_of.statistics, end.statistics
    )
    np.testing.assert_allclose(info_of.captured[:, :3], info.captured)


def test_tasks_draw_teams_speeds_and_radii():
    settings = dataclasses.replace(
        TEAMS, evader_speeds=(0.8, 2.0), capture_radii=(0.2, 0.4), arena_radii=(0.7, 1.4)
    )
    keys = jax.random.split(jax.random.key(0), 300)
    tasks = jax.jit(jax.vmap(lambda key: uniform_task(settings, key)))(keys)
    sizes, counts = np.unique(np.sum(tasks.active, axis=1), return_counts=True)
    assert list(sizes) == [1, 3, 5] and counts.min() > 70
    for numbers, low, high in (
        (tasks.evader_speed, 0.8, 2.0),
        (tasks.capture_radius, 0.2, 0.4),
        (tasks.arena_radius, 0.7, 1.4),
    ):
        assert low <= numbers.min() < low + 0.05 and high - 0.05 < numbers.max() <= high
    assert np.all(jax.vmap(lambda task: starts_clear(settings, task))(tasks))


def test_what_moves_starts_leaves_empty_slots_far_away():
    task = drawn_task(dataclasses.replace(TEAMS, team_sizes=()), jax.random.key(0))
    task = task.replace(active=jnp.arange(5) < 3).with_starts(task.pursuer_position)

    @jax.jit
    def moves(key, task):
        return {
            "expand": expand_task(TEAMS, key, task),
            "close": close_starts(TEAMS, key, task, 1.0),
            "scatter": scatter_starts(TEAMS, key, task),
            "turn": turn_task(key, task),
        }

    for name, other in moves(jax.random.key(1), task).items():
        assert np.any(other.pursuer_position[:3] != task.pursuer_position[:3]), name
        distance = np.linalg.norm(other.pursuer_position[3:, :2], axis=1)
        assert np.all(distance > 500.0), name


def test_a_term_of_ones_own_counts_nothing_for_empty_slots():
    game = Pursuit(TEAMS, reward=(*default_reward(REWARD), Term(lambda t: jnp.ones(()), 3.0)))
    task = drawn_task(TEAMS, jax.random.key(0)).replace(active=jnp.arange(5) < 1)
    _, state = jax.jit(game.reset_to)(jax.random.key(0), task)
    reward = jax.jit(game.step)(jax.random.key(0), state, jnp.zeros((5, 4)))[2]
    assert reward[0] != 0.0 and not np.any(reward[1:])


@pytest.mark.parametrize(
    "changes", [{"team_sizes": (2, 6)}, {"evader_speeds": (1.0,)}, {"arena_radii": (0.9, 0.7)}]
)
def test_impossible_teams_are_refused(changes):
    with pytest.raises(UserError, match=next(iter(changes))):
        dataclasses.replace(TEAMS, **changes)


def test_one_falls_out_and_the_others_fly_on_as_a_smaller_team():
    """From its last step on nothing of it is left, and what the others see is what two
    would.
    """
    settings = dataclasses.replace(ALONE, fall_outs=1.0, fall_out_seconds=(0.03, 0.03))
    task = drawn_task(settings, jax.random.key(3)).replace(evader=jnp.int32(0))
    game = Pursuit(settings)

    @jax.jit
    def fly(key):
        def one(state, _):
            observation, state, reward, *_ = game.step(None, state, jnp.zeros((3, 4)))
            return state, (observation, reward, state.active)

        return jax.lax.scan(one, game.reset_to(key, task)[1], None, length=6)

    fallen = set()
    for key in range(6):
        state, (observation, reward, active) = fly(jax.random.key(key))
        gone = int(np.argmin(active[-1]))
        fallen.add(gone)
        np.testing.assert_array_equal(active[:, gone], [1, 1, 1, 0, 0, 0])
        assert np.all(np.delete(active, gone, axis=1))
        np.testing.assert_array_equal(
            np.any(observation.self_state[:, gone], axis=1), active[:, gone]
        )
        assert np.all(reward[:3, gone] != 0.0) and not np.any(reward[3:, gone])
        assert state.drones.position[gone, 0] > 500.0
    assert len(fallen) > 1
