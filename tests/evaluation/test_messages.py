"""Messages between pursuers that are lost or late."""

import jax
import jax.numpy as jnp
import numpy as np

from openjax import Pursuit, PursuitSettings
from openjax.evaluation.message_settings import MessageSettings
from openjax.evaluation.messages import Hearsay

GAME = PursuitSettings(
    track_unseen=True,
    physics="rigid",
    contacts=False,
    observe_in="heading",
    observe_history=2,
    history_length=4,
    strategies=2,
    strategy_seconds=0.03,
)
STEPS = 12


def flights(messages):
    """From a key to states, the game's observations and those in the pursuers' views,
    by step.
    """
    game = Pursuit(GAME)
    hearsay = Hearsay(messages, game)

    def one(carry, key):
        state, beliefs = carry
        observation, state, *_ = game.step(None, state, 0.5 * jax.random.normal(key, (3, 4)))
        beliefs = hearsay.update(beliefs, state, key)
        views = hearsay.observations(beliefs, state)
        return (state, beliefs), (state, observation, views)

    @jax.jit
    def fly(key):
        state = game.reset(key)[1]
        return jax.lax.scan(one, (state, hearsay.start(state)), jax.random.split(key, STEPS))[1]

    return fly


def test_perfect_messages_give_all_the_games_own_view():
    _, observation, views = flights(MessageSettings())(jax.random.key(0))
    for name in ("self_state", "others", "pillars", "position", "heading"):
        np.testing.assert_allclose(
            getattr(views, name)[:, :, 0], getattr(observation, name), atol=1e-5, err_msg=name
        )
    for name in ("last_seen", "frames", "strategy"):
        wanted = np.repeat(getattr(observation, name)[:, None], 3, axis=1)
        np.testing.assert_allclose(getattr(views, name), wanted, atol=1e-5, err_msg=name)


def test_late_messages_show_teammates_where_they_told_they_would_be():
    delay = 3
    late = MessageSettings(late=delay * GAME.time_step)
    states, _, views = flights(late)(jax.random.key(0))
    told = np.asarray(states.drones.position + late.late * states.drones.velocity)
    position = np.asarray(states.drones.position)
    heights = views.others[:, :, 0, :, 2]  # those aren't turned
    for t in range(delay, STEPS):
        for i in range(3):
            others = np.delete(told[t - delay, :, 2], i)
            np.testing.assert_allclose(heights[t, i], position[t, i, 2] - others, atol=1e-5)


def test_who_hears_nothing_knows_what_it_sees_itself():
    fly = flights(MessageSettings(lost=1.0))
    for seed in range(20):
        states, observation, views = fly(jax.random.key(seed))
        sees = np.asarray(states.in_sight)
        if sees.any() and not sees.all():
            break
    hidden = np.all(views.self_state[:, :, 0, :3] == -5.0, axis=-1)
    np.testing.assert_array_equal(hidden, ~sees)
    start = views.others[0, :, 0, :, 2] - observation.position[0, :, None, 2]
    for t in range(STEPS):
        others = views.others[t, :, 0, :, 2] - observation.position[t, :, None, 2]
        np.testing.assert_allclose(others, start, atol=1e-5)
    assert jnp.all(views.position[:, :, 0] == observation.position)
