"""Probe environments whose values and best actions are known, each of which isolates
one part of MAPPO.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.learning.learners.learner import Experience
from openjax.learning.learners.mappo import Mappo, every_nth, follow_kl, make_optimiser
from openjax.learning.presets import preset
from openjax.learning.rollout import Rollout
from openjax.learning.settings import MappoSettings
from openjax.policy import NetworkSettings, Policy, PredictorSettings, gaussian_log_prob
from openjax.pursuit import Observation

STEPS = 2
WORLDS = 64
UPDATES = 120
DISCOUNT = 0.5


class Probed(MappoSettings):
    """Learns rewards of the order of one."""

    REWARD_SCALE = 1.0


SETTINGS = Probed(
    learning_rate=5e-3,
    minibatches=2,
    clip_epsilon=0.2,
    entropy_coefficient=0.0,
    discount=DISCOUNT,
)
POLICY = Policy(
    NetworkSettings(features=16, heads=2),
    PredictorSettings(enabled=False),
    initial_action=(0.0, 0.0, 0.0, 0.0),
)


def observation_of(flag, late):
    """What one pursuer sees: a random sign, and whether this is the second step."""
    leading = flag.shape
    return Observation(
        self_state=jnp.stack([flag, late], axis=-1)[..., None, :],
        others=jnp.zeros((*leading, 1, 0, 3)),
        pillars=jnp.full((*leading, 1, 1, 5), -5.0),
        pillar_seen=jnp.zeros((*leading, 1, 1), bool),
        privileged=jnp.zeros((*leading, 1, 10)),
        position=jnp.zeros((*leading, 1, 3)),
        last_seen=jnp.zeros((*leading, 3)),
        frames=jnp.zeros((*leading, 1, 10)),
    )


def flags(key, length):
    return jnp.where(jax.random.bernoulli(key, 0.5, (length, WORLDS)), 1.0, -1.0)


def one_update(learner, probe, carry, key):
    """The update after a rollout of one probe; carry: MAPPO's state and the parameters.
    Also its metrics.
    """
    state, parameters = carry
    policy = learner.policy
    flag_key, noise_key, shuffle_key = jax.random.split(key, 3)
    flag = flags(flag_key, STEPS + 1)
    late = jnp.broadcast_to(jnp.arange(STEPS, dtype=jnp.float32)[:, None], (STEPS, WORLDS))
    observation = observation_of(flag[:-1], late)
    mean, log_std = policy.distribution(parameters.actor, observation, None)
    action = mean + jnp.exp(log_std) * jax.random.normal(noise_key, mean.shape)
    miss = (policy.action(action)[..., 0, 0] - 0.5 * flag[:-1]) ** 2
    reward = (
        probe["constant"]
        + probe["by_flag"] * flag[:-1]
        + probe["by_step"] * late
        - probe["by_action"] * miss
    )
    rollout = Rollout(
        observation=observation,
        predicted=None,
        action=action,
        log_prob=gaussian_log_prob(action, mean, log_std),
        reward=reward[..., None],
        terminated=jnp.broadcast_to(probe["terminated"][:, None], (STEPS, WORLDS)),
        truncated=jnp.broadcast_to(probe["truncated"][:, None], (STEPS, WORLDS)),
        evader=jnp.zeros((STEPS, WORLDS, 3)),
    )
    last = observation_of(flag[-1], jnp.ones(WORLDS))
    flown = Experience(rollout, frames=None, observation=last, state=None, predicted=None)
    state, parameters, metrics = learner.learn(state, parameters, flown, shuffle_key)
    return (state, parameters), metrics


CORNERS = (
    np.array([[-1.0, -1.0], [1.0, 1.0]], np.float32),
    np.array([[0.0, 1.0], [0.0, 1.0]], np.float32),
)
"""Flag and second step, of flag -1, +1 (rows) in the first, second step (columns)."""


def trained(settings, policy, updates):
    """`train(probe)`: MAPPO's state and the parameters after `updates`, metrics
    (updates,).
    """
    learner = Mappo(settings, policy, updates)

    @jax.jit
    def train(probe):
        parameters = policy.init(jax.random.key(0), observation_of(*map(jnp.array, CORNERS)))
        return jax.lax.scan(
            lambda carry, key: one_update(learner, probe, carry, key),
            (learner.start(parameters, jax.random.key(0)), parameters),
            jax.random.split(jax.random.key(1), updates),
        )

    return train


def probe_of(
    constant=0.0,
    by_flag=0.0,
    by_step=0.0,
    by_action=0.0,
    terminated=(True, True),
    truncated=(False, False),
):
    """The reward is constant + by_flag * flag + by_step * (second step) - by_action *
    (first action
    - 0.5 flag)^2.
    """
    numbers = dict(constant=constant, by_flag=by_flag, by_step=by_step, by_action=by_action)
    probe = {name: jnp.float32(value) for name, value in numbers.items()}
    return probe | {"terminated": jnp.array(terminated), "truncated": jnp.array(truncated)}


@pytest.fixture(scope="module")
def learn():
    """Train on a probe; returns values and mean actions in the corners."""
    train = trained(SETTINGS, POLICY, UPDATES)

    @jax.jit
    def call(probe):
        (state, parameters), _ = train(probe)
        actor = parameters.actor
        critic = parameters.critic
        mean, std = state.value_scale.moments
        corners = observation_of(*map(jnp.array, CORNERS))
        value = mean + std * POLICY.value(actor, critic, corners, None)[..., 0]
        return value, POLICY.action(POLICY.distribution(actor, corners, None)[0])[..., 0, :]

    return lambda **probe: jax.device_get(call(probe_of(**probe)))


def test_constant_reward_is_the_value(learn):
    np.testing.assert_allclose(learn(constant=1.0)[0], 1.0, atol=0.05)


def test_value_depends_on_the_observation(learn):
    np.testing.assert_allclose(learn(by_flag=1.0)[0], [[-1, -1], [1, 1]], atol=0.15)


def test_a_later_reward_is_discounted(learn):
    value, _ = learn(by_step=1.0, terminated=(False, True))
    np.testing.assert_allclose(value, [[DISCOUNT, 1], [DISCOUNT, 1]], atol=0.1)


def test_a_cut_episode_goes_on_in_the_value(learn):
    value, _ = learn(constant=1.0, terminated=(False, False), truncated=(False, True))
    np.testing.assert_allclose(value, 1 / (1 - DISCOUNT), atol=0.1)


def test_the_policy_finds_the_action_that_the_observation_asks_for(learn):
    _, action = learn(by_action=1.0)
    np.testing.assert_allclose(action[..., 0], [[-0.5, -0.5], [0.5, 0.5]], atol=0.15)


def test_the_actor_can_start_to_learn_later_than_the_critic():
    settings = dataclasses.replace(SETTINGS, actor_start=0.5, minibatches=1)
    parameter = jnp.ones(3)
    moves = []
    for optimiser in make_optimiser(settings, 4):
        state = optimiser.init(parameter)
        own = []
        for _ in range(4 * settings.EPOCHS):
            change, state = optimiser.update(parameter, state, parameter)
            own.append(float(jnp.abs(change).max()))
        moves.append(own)
    half = 2 * settings.EPOCHS
    assert set(moves[0][:half]) == {0.0} and min(moves[0][half:]) > 0.0
    assert min(moves[1]) > 0.0


def test_steps_shrink_while_the_policy_has_moved_too_far_and_grow_again():
    scaled = follow_kl(0.01)
    change = jnp.ones(3)
    state = scaled.init(jnp.ones(3))
    scales = []
    for kl in [0.0] * 30 + [0.015] * 3 + [0.03] * 5 + [jnp.inf, jnp.nan] + [0.001] * 9:
        step, state = scaled.update(change, state, kl=jnp.float32(kl))
        scales.append(float(step[0]))
    rise = scales[:30]
    rest = scales[30:33]
    fall = scales[33:40]
    again = scales[40:]
    assert rise == sorted(rise) and rise[-1] == 1.0 and set(rest) == {1.0}
    np.testing.assert_allclose(fall, 1.5 ** -np.arange(1.0, 8.0), rtol=1e-5)
    assert again[-1] == 1.0
    # an actor that is still frozen doesn't earn larger steps
    _, frozen = scaled.update(jnp.zeros(3), scaled.init(change), kl=jnp.float32(0.0))
    assert frozen == scaled.init(change)


def test_a_policy_with_little_noise_stays_near_itself():
    """Without the target an update goes more than a thousand times as far."""
    network = dataclasses.replace(POLICY.network, initial_log_std=-5.0)
    policy = dataclasses.replace(POLICY, network=network)

    class Thorough(Probed):
        EPOCHS = 8

    settings = Thorough(**dataclasses.asdict(SETTINGS) | dict(minibatches=8, target_kl=0.01))
    kl = np.asarray(trained(settings, policy, 15)(probe_of(by_action=1.0))[1]["kl"])
    # the samples of a minibatch are few, so that some updates go a few times as far
    assert 0.5 * 0.01 < kl.mean() < 5 * 0.01 and kl.max() < 10 * 0.01


def test_a_gradient_step_may_see_every_third_step_of_all_worlds():
    steps = jnp.broadcast_to(jnp.arange(12)[None, :, None], (5, 12, 2))
    thirds = jnp.stack([every_nth(steps, jnp.int32(first), 3) for first in range(3)])
    np.testing.assert_array_equal(thirds[1, 4, :, 0], [1, 4, 7, 10])
    np.testing.assert_array_equal(
        np.sort(thirds[:, 2, :, 1], axis=None), np.arange(12)
    )  # none left out
    assert every_nth(steps, None, 1) is steps
    with pytest.raises(UserError, match="step_subsampling 3 must divide rollout_length 80"):
        preset("paper", mappo=MappoSettings(minibatches=16, step_subsampling=3))
