"""Vehicles of their own in the game: drawn anew in each episode, shown to the critic;
the history shown to the actor.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.settings import OWN_FRAME

KEY = jax.random.key(4)
FAMILY = (
    ("mass.extra", -0.002, 0.004, 0.0, 0.0),
    ("state_latency.delay", 0.02, 0.03, 0.02, 0.03),
    ("view_noise.position", 0.001, 0.001, 0.001, 0.001),
)
SETTINGS = PursuitSettings(
    physics="stops",
    speed_limit="none",
    vehicles=FAMILY,
    observe_history=3,
    history_spacing=2,
)


@pytest.fixture(scope="module")
def flown():
    """An environment, its start, and ten steps of ever new actions: actions, states,
    observations.
    """
    environment = Pursuit(SETTINGS)
    observation, state = jax.jit(environment.reset)(KEY)
    actions = jax.random.uniform(KEY, (10, 3, 4), minval=-0.3, maxval=0.3)

    def one(state, action):
        observation, state, *_ = environment.step(KEY, state, action)
        return state, (state, observation)

    states, observations = jax.jit(lambda state: jax.lax.scan(one, state, actions)[1])(state)
    return environment, observation, state, actions, states, observations


def test_sizes_are_those_that_the_settings_announce(flown):
    _, observation, *_ = flown
    assert observation.self_state.shape == (3, SETTINGS.self_size)
    assert observation.privileged.shape == (3, SETTINGS.privileged_size)


def test_every_episode_and_pursuer_has_its_vehicle_and_keeps_it(flown):
    environment, _, state, _, states, _ = flown
    mass = state.vehicles["mass"]["extra"]
    assert len(set(mass.tolist())) == 3
    np.testing.assert_array_equal(states.vehicles["mass"]["extra"], np.broadcast_to(mass, (10, 3)))
    other = jax.jit(environment.reset)(jax.random.key(5))[1].vehicles["mass"]["extra"]
    assert not set(mass.tolist()) & set(other.tolist())
    assert np.all((mass >= -0.002) & (mass <= 0.004))


def test_bounds_given_later_go_before_those_of_the_settings():
    bounds = jnp.array([[0.009, 0.01] * 2, [0.0] * 4, [0.0] * 4])
    reset = jax.jit(lambda bounds: Pursuit(SETTINGS, vehicle_bounds=bounds).reset(KEY)[1].vehicles)
    assert np.all(reset(bounds)["mass"]["extra"] >= 0.009)


def test_history_is_what_was_seen_and_commanded(flown):
    _, _, _, actions, _, observations = flown
    own = observations.self_state
    history = np.asarray(own[..., -3 * OWN_FRAME :]).reshape(
        10, 3, 3, OWN_FRAME
    )  # step, pursuer, frame
    velocity = np.asarray(own[..., 7:10])
    for k, back in ((2, 0), (1, 2), (0, 4)):  # frames two steps apart, the newest last
        np.testing.assert_allclose(history[9, :, k, -4:], actions[9 - back], atol=1e-6)
        np.testing.assert_allclose(history[9, :, k, :3], velocity[9 - back], atol=1e-6)


def test_poses_are_seen_late_by_the_actor_and_truly_by_the_critic(flown):
    _, _, _, _, states, observations = flown
    true = np.asarray(states.drones.position)
    np.testing.assert_allclose(observations.privileged[..., 6:9], true, atol=1e-6)
    off = np.linalg.norm(np.asarray(observations.position) - true, axis=-1)[6:]
    speed = np.linalg.norm(states.drones.velocity, axis=-1)[6:]
    assert np.median(off / speed) == pytest.approx(0.025, abs=0.015)


def test_without_a_family_nothing_is_carried():
    environment = Pursuit(dataclasses.replace(SETTINGS, vehicles=(), observe_history=0))
    state = jax.eval_shape(environment.reset, KEY)[1]
    assert not jax.tree.leaves((state.vehicles, state.own_history, state.drones.effect_memory))
