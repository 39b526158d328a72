"""Rollouts and the predictor's training on them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.learning.learners.learner import Experience
from openjax.learning.learners.predictor_update import (
    PredictorLearner,
    make_predictor_optimiser,
    prediction_loss,
    windows_and_labels,
)
from openjax.learning.rollout import ExplorationNoise, Players, Rollout, collect
from openjax.policy import (
    NetworkSettings,
    Policy,
    PolicyParameters,
    PredictorSettings,
    gaussian_log_prob,
)
from openjax.pursuit import Observation, Pursuit, PursuitSettings
from tests.policy.parameters import random_parameters

WORLDS = 2
STEPS = 6
HORIZONS = (1, 3)
GAME = PursuitSettings(
    physics="rigid",
    episode_length=12,
    history_length=3,
    history_spacing=2,
    num_pursuers=2,
    drone_clearance=0.9,
)


@pytest.fixture(scope="module")
def recorded():
    """Two rollouts, world 1 reset between them; each with the state it starts from and
    the game's own account.
    """
    environment = Pursuit(GAME)
    policy = Policy.for_environment(
        environment,
        NetworkSettings(features=8, heads=2),
        PredictorSettings(units=4, horizons=HORIZONS, windows=2),
    )

    @jax.jit
    def play(parameters, observation, state, key, share):
        noise = jax.random.normal(key, (STEPS, WORLDS, GAME.num_pursuers, 4))
        players = Players(environment, policy, parameters)
        rollout, last, after = collect(
            players, (observation, state), ExplorationNoise(noise), share
        )

        def one(carry, action):
            observation, state = carry
            following, state, reward, _, _, info = jax.vmap(environment.step, (None, 0, 0))(
                key, state, policy.action(action)
            )
            return (following, state), (observation, state.evader_position, reward, info.penalty)

        (own_last, _), account = jax.lax.scan(one, (observation, state), rollout.action)
        mean, log_std = policy.distribution(
            parameters.actor, rollout.observation, rollout.predicted
        )
        density = gaussian_log_prob(rollout.action, mean, log_std)
        own_noise = (rollout.action - mean) / jnp.exp(log_std)
        return rollout, last, after, (account, own_last, density, own_noise - noise)

    reset = jax.jit(jax.vmap(environment.reset))
    observation, state = reset(jax.random.split(jax.random.key(0), WORLDS))
    parameters = random_parameters(policy, observation)
    runs = []
    for number, share in enumerate((1.0, 0.25)):
        rollout, last, after, account = play(
            parameters, observation, state, jax.random.key(number), share
        )
        runs.append((state, rollout, last, account))
        fresh = reset(jax.random.split(jax.random.key(7), WORLDS))
        observation, state = jax.tree.map(lambda x, new: x.at[1].set(new[1]), (last, after), fresh)
    return policy, runs


def test_a_rollout_is_what_the_game_says(recorded):
    _, runs = recorded
    for (_, rollout, last, (account, own_last, density, noise_error)), share in zip(
        runs, (1.0, 0.25), strict=True
    ):
        observation, evader, reward, penalty = account
        np.testing.assert_allclose(
            rollout.observation.self_state, observation.self_state, atol=1e-5
        )
        np.testing.assert_allclose(last.self_state, own_last.self_state, atol=1e-5)
        np.testing.assert_allclose(rollout.evader, evader, atol=1e-5)
        np.testing.assert_allclose(rollout.log_prob, density, atol=1e-3)
        np.testing.assert_allclose(noise_error, 0.0, atol=1e-3)
        # with a share of the penalties the rest of them is given back
        assert penalty.min() <= -10
        np.testing.assert_allclose(rollout.reward, reward - (1 - share) * penalty, atol=1e-4)
    assert runs[1][1].terminated[:, 0].tolist() == [False] * 5 + [True]
    assert not runs[1][1].terminated[:, 1].any() and not runs[0][1].terminated.any()


def test_windows_and_labels_are_those_of_the_game_and_cross_no_reset(recorded):
    policy, runs = recorded
    room = STEPS - HORIZONS[-1] + 1
    times = jnp.tile(jnp.arange(room), (WORLDS, 1))
    for start, rollout, _, ((observation, evader, _, _), *_) in runs:
        frames, last_seen, positions = windows_and_labels(policy, 2, start.frames, rollout, times)
        assert frames.shape[1:3] == (room, 3)
        for world in range(WORLDS):
            for t in range(room):
                np.testing.assert_allclose(
                    frames[world, t], observation.frames[t, world], atol=1e-5
                )
                np.testing.assert_allclose(
                    last_seen[world, t], observation.last_seen[t, world], atol=1e-5
                )
                for k, horizon in enumerate(HORIZONS):
                    np.testing.assert_allclose(
                        positions[world, t, k], evader[t + horizon - 1, world], atol=1e-5
                    )
    # the world that was reset starts anew: its windows hold times of the new episode
    # only
    _, rollout, _, _ = runs[1]
    start = runs[1][0]
    frames, _, _ = windows_and_labels(policy, 2, start.frames, rollout, times)
    np.testing.assert_allclose(frames[1, :, -1, 0], np.arange(room) / 12, atol=1e-6)
    assert (frames[1, :, :, 0] <= np.arange(room)[:, None] / 12 + 1e-6).all()
    np.testing.assert_allclose(frames[0, :, -1, 0], (STEPS + np.arange(room)) / 12, atol=1e-6)


@pytest.mark.slow
def test_learns_a_circling_evader():
    """An evader that circles at 1.3 m/s in view is foreseen far better than by keeping
    where it was last seen.
    """
    worlds = 32
    steps = 20
    span = 10
    radius = 0.5

    class Fast(PredictorSettings):
        LEARNING_RATE = 6e-3

    settings = Fast(units=32, horizons=(1, 5))
    policy = Policy(predictor=settings)
    learner = PredictorLearner(policy, PursuitSettings(), total_updates=150)
    time = jnp.arange(-span, steps + 1)

    def circle(key):
        """Frames of a world at all times, and the positions."""
        phase_key, sign_key = jax.random.split(key)
        sign = jnp.where(jax.random.bernoulli(sign_key), 1.0, -1.0)
        turn = (
            jax.random.uniform(phase_key, (), maxval=2 * jnp.pi) + sign * 1.3 * 0.01 / radius * time
        )
        position = jnp.stack(
            [radius * jnp.cos(turn), radius * jnp.sin(turn), jnp.full_like(turn, 0.6)], axis=-1
        )
        velocity = (
            1.3 * sign * jnp.stack([-jnp.sin(turn), jnp.cos(turn), jnp.zeros_like(turn)], axis=-1)
        )
        pursuer = jnp.zeros((len(time), 3))
        return jnp.concatenate(
            [jnp.zeros((len(time), 1)), position, velocity, pursuer], axis=-1
        ), position

    def rollout_of(key):
        frames, position = jax.vmap(circle)(jax.random.split(key, worlds))
        frames = jnp.swapaxes(frames, 0, 1)
        position = jnp.swapaxes(position, 0, 1)
        nothing = jnp.zeros((steps, worlds, 1))
        observation = Observation(
            *[nothing] * 6, last_seen=position[span:-1], frames=frames[span:-1, :, None]
        )
        rollout = Rollout(
            observation,
            jnp.zeros((steps, worlds, 2, 3)),
            *[nothing] * 3,
            terminated=None,
            truncated=None,
            evader=position[span + 1 :],
        )
        return jnp.swapaxes(frames[1 : span + 1], 0, 1), rollout

    def update(carry, key):
        state, parameters = carry
        data_key, window_key = jax.random.split(key)
        earlier, rollout = rollout_of(data_key)
        flown = Experience(rollout, earlier, observation=None, state=None, predicted=None)
        state, parameters, metrics = learner.learn(state, parameters, flown, window_key)
        return (state, parameters), metrics["predictor_loss"]

    def errors(parameters, key):
        earlier, rollout = rollout_of(key)
        times = jnp.tile(jnp.arange(steps - 4), (worlds, 1))
        frames, last_seen, positions = windows_and_labels(policy, 1, earlier, rollout, times)
        predicted = policy._predictor.apply(parameters, frames, last_seen)
        return [
            jnp.linalg.norm(guess - positions, axis=-1).mean(axis=(0, 1))
            for guess in (predicted, last_seen[:, :, None])
        ]

    @jax.jit
    def train(key):
        earlier, rollout = rollout_of(key)
        parameters = policy._predictor.init(key, earlier, rollout.observation.last_seen[0])
        parameters = PolicyParameters(actor={}, critic={}, predictor=parameters)
        start = learner.start(parameters, key), parameters
        (_, parameters), loss = jax.lax.scan(update, start, jax.random.split(key, 150))
        return loss, errors(parameters.predictor, jax.random.key(99))

    loss, (learnt, kept) = train(jax.random.key(0))
    np.testing.assert_allclose(kept, [0.013, 0.065], rtol=0.02)
    assert (np.asarray(learnt) < 0.4 * np.asarray(kept)).all(), learnt
    assert loss[-10:].mean() < 0.1 * loss[0]


def test_the_loss_counts_in_flown_distances_what_was_seen_before():
    """The evader flies 0.02 m in one step here and 0.2 m in ten."""
    game = PursuitSettings(evader_speed=2.0, arena_height=1.0)
    settings = PredictorSettings(horizons=(1, 10))
    true = jnp.zeros((2, 2, 3))
    predicted = (
        true.at[:, 0, 0].set(0.02).at[:, 1, 0].set(0.4)
    )  # one and two flown distances too far along x
    # the first stands for: not yet seen
    last_seen = jnp.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])

    loss = float(prediction_loss(settings, game, predicted, last_seen, true))
    assert loss == pytest.approx((1 + 4) / 12, rel=1e-5)


def test_step_size_reaches_zero_at_the_end_of_the_run():
    """Adam's steps along a constant gradient are as large as its step size."""
    updates = 5
    settings = PredictorSettings()
    optimiser = make_predictor_optimiser(settings, updates)
    state = optimiser.init(jnp.zeros(()))
    moved = []
    for _ in range(updates * settings.steps + 1):
        step, state = optimiser.update(jnp.ones(()), state)
        moved.append(-float(step))
    expected = settings.LEARNING_RATE * np.linspace(1, 0, len(moved))
    np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-9)
