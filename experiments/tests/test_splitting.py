"""The judge that is kept apart, where the truth is known."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaders.points import Team, game_of_points
from experiments.evaders.splitting import Splitting, SplittingSettings, sources
from openjax.pursuit import Task

SETTINGS = SplittingSettings(copies=256)


def straight(observation):
    """At the evader."""
    to_evader = -observation.self_state[..., :3]
    return to_evader / jnp.linalg.norm(to_evader, axis=-1, keepdims=True)


def in_the_open(speed):
    """A game of one point in the open, and one task of it, .5 m from the evader."""
    game = game_of_points(
        num_pursuers=1,
        evader_speed=speed,
        arena_radius=10.0,
        arena_height=10.0,
        evaders=("field",),
        episode_length=160,
    )
    middle = jnp.array([[0.0, 0.0, 5.0]])
    away = jnp.array([[0.5, 0.0, 0.0]])
    task = Task(middle + away, middle[0], jnp.zeros((1, 2)), jnp.zeros(1, bool))
    return game, jax.tree.map(lambda leaf: leaf[None], task)


def test_a_slower_evader_is_free_nearly_as_long_as_it_can_be():
    """(d - r) / (v_p - v_e), and no longer."""
    game, tasks = in_the_open(speed=0.8)
    fly = jax.jit(Splitting(SETTINGS, game, Team(straight)).fly)
    found = fly({}, tasks, jax.random.key(0))
    exact = (0.5 - game.settings.capture_radius) / (game.settings.max_speed - 0.8)
    seconds = found.capture_step[0] * game.settings.time_step
    assert found.captured[0]
    assert 0.97 * exact <= seconds <= exact + game.settings.time_step


def test_the_caught_go_on_as_the_free():
    game, tasks = in_the_open(speed=1.3)
    keys = jax.random.split(jax.random.key(0), 1)
    state = jax.jit(jax.vmap(game.reset_to))(keys, tasks)[1]
    state = jax.tree.map(lambda leaf: jnp.repeat(leaf, 6, axis=0), state)
    caught = jnp.array([True, False, True, False, True, True])
    state = state.replace(statistics=state.statistics.replace(captured=caught))
    place = np.asarray(sources(jax.random.key(1), state))
    assert place[1] == 1 and place[3] == 3
    assert not np.asarray(caught)[place].any()
    all_caught = state.replace(statistics=state.statistics.replace(captured=jnp.ones(6, bool)))
    np.testing.assert_array_equal(sources(jax.random.key(1), all_caught), np.arange(6))
