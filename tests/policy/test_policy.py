"""Actor, critic and predictor as a user of the policy sees them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from openjax.errors import UserError
from openjax.policy import (
    NetworkSettings,
    Policy,
    PredictorSettings,
    gaussian_entropy,
    gaussian_log_prob,
)
from openjax.policy.predictor import EvaderPredictor
from openjax.pursuit import Observation
from tests.policy.parameters import random_parameters

N = 3
BATCH = 4
POLICY = Policy(NetworkSettings(features=16, heads=2), PredictorSettings(units=8, horizons=(1, 2)))


def observation_of(seed, n=N, pillars=3, batch=BATCH):
    draw = np.random.default_rng(seed)

    def normal(*shape):
        return draw.normal(size=(batch, *shape)).astype(np.float32)

    seen = draw.uniform(size=(batch, n, pillars)) < 0.6
    seen[:2] = [[[False]], [[True]]]
    observation = Observation(
        self_state=normal(n, 20),
        others=normal(n, n - 1, 3),
        pillars=np.where(seen[..., None], normal(n, pillars, 5), np.float32(-5.0)),
        pillar_seen=seen,
        privileged=normal(n, 10),
        position=normal(n, 3),
        last_seen=0.3 * normal(3),
        frames=0.3 * normal(10, 7 + 3 * n),
    )
    return jax.tree.map(jnp.asarray, observation)


@pytest.fixture(scope="module")
def networks():
    """(parameters, function to mean and value)."""

    def both(parameters, observation):
        predicted = POLICY.predict(parameters, observation)
        mean, _ = POLICY.distribution(parameters.actor, observation, predicted)
        return mean, POLICY.value(parameters.actor, parameters.critic, observation, predicted)

    return random_parameters(POLICY, observation_of(0)), jax.jit(both)


def test_order_of_others_and_pillars_does_not_matter(networks):
    parameters, both = networks
    observation = observation_of(1)
    order = jnp.array([2, 0, 1])
    changed = observation.replace(
        others=observation.others[:, :, ::-1],
        pillars=observation.pillars[:, :, order],
        pillar_seen=observation.pillar_seen[:, :, order],
    )
    for a, b in zip(both(parameters, observation), both(parameters, changed), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_unused_slots_have_no_influence_and_used_ones_have(networks):
    parameters, both = networks
    observation = observation_of(2)
    for used in (False, True):
        change = (observation.pillar_seen == used)[..., None]
        changed = observation.replace(pillars=jnp.where(change, 7.0, observation.pillars))
        for a, b in zip(both(parameters, observation), both(parameters, changed), strict=True):
            same = np.all(np.asarray(a == b).reshape(BATCH, N, -1), axis=-1)
            expected = (
                ~np.asarray(observation.pillar_seen).any(axis=-1)
                if used
                else np.ones((BATCH, N), bool)
            )
            np.testing.assert_array_equal(same, expected)


def test_pursuers_share_one_actor_and_worlds_do_not_mix(networks):
    parameters, both = networks
    observation = observation_of(3)
    mean, value = both(parameters, observation)
    one = jax.tree.map(lambda x: x[1:2], observation)
    shuffled = jnp.array([2, 0, 1])
    fields = ("self_state", "others", "pillars", "pillar_seen", "privileged", "position")
    turned = observation.replace(
        **{name: getattr(observation, name)[:, shuffled] for name in fields}
    )
    for a, b in zip((mean, value), both(parameters, turned), strict=True):
        np.testing.assert_allclose(a[:, shuffled], b, atol=1e-5)
    for a, b in zip((mean, value), jax.tree.map(lambda x: x, both(parameters, one)), strict=True):
        np.testing.assert_allclose(a[1:2], b, atol=1e-5)


def test_what_is_privileged_is_the_critics_alone(networks):
    parameters, both = networks
    observation = observation_of(4)
    mean, value = both(parameters, observation)
    more_mean, more_value = both(
        parameters, observation.replace(privileged=observation.privileged + 1)
    )
    np.testing.assert_array_equal(mean, more_mean)
    assert (value != more_value).all()


def test_a_critic_of_layers_sees_all_and_each_pursuer_its_own():
    policy = Policy(
        NetworkSettings(features=16, heads=2, critic_encoder="layers"),
        PredictorSettings(enabled=False),
    )
    observation = observation_of(4)
    parameters = random_parameters(policy, observation)

    @jax.jit
    def slopes(observation):
        def of_first(observation):
            return jnp.sum(
                policy.value(parameters.actor, parameters.critic, observation, None)[:, 0]
            )

        return jax.grad(of_first, allow_int=True)(observation)

    slopes = slopes(observation)
    for name in ("self_state", "others", "pillars", "privileged"):
        slope = getattr(slopes, name)
        assert (slope[:, 0] != 0).all(), name
        assert (slope[:, 1:] == 0).all(), name


def test_one_pursuer_without_predictor_starts_near_hover():
    policy = Policy(
        NetworkSettings(features=16, heads=4, compute_type="bfloat16"),
        PredictorSettings(enabled=False),
        initial_action=(0.3, 0.0, 0.0, 0.0),
    )
    observation = observation_of(5, n=1, pillars=1)
    parameters = jax.jit(policy.init)(jax.random.key(0), observation)
    assert parameters.predictor == {} and policy.predict(parameters, observation) is None
    action = jax.jit(policy.act)(parameters, observation)
    np.testing.assert_allclose(
        action, np.broadcast_to([np.tanh(0.3), 0, 0, 0], (BATCH, 1, 4)), atol=0.1
    )
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(parameters))


@pytest.mark.parametrize("squash", ["mean", "sample"])
def test_mean_and_samples_are_actions_within_bounds(squash):
    policy = Policy(
        NetworkSettings(features=16, heads=2, squash=squash),
        PredictorSettings(enabled=False),
        initial_action=(3.0,) * 4,
    )
    observation = observation_of(5)
    parameters = jax.jit(policy.init)(jax.random.key(0), observation)
    mean, log_std = jax.jit(policy.distribution)(parameters.actor, observation, None)
    np.testing.assert_allclose(mean, np.tanh(3.0) if squash == "mean" else 3.0, atol=0.1)
    sample = mean + jnp.exp(log_std) * jax.random.normal(jax.random.key(1), mean.shape)
    expected = np.clip(sample, -1, 1) if squash == "mean" else np.tanh(sample)
    np.testing.assert_allclose(policy.action(sample), expected, atol=1e-6)
    action = jax.jit(policy.act)(parameters, observation)
    np.testing.assert_allclose(action, policy.action(mean), atol=1e-6)


def test_density_and_entropy():
    draw = np.random.default_rng(0)
    sample, mean = draw.normal(size=(2, 5, 4))
    log_std = np.array([-1.0, 0.0, 0.5, -0.2])
    density = gaussian_log_prob(jnp.asarray(sample), jnp.asarray(mean), jnp.asarray(log_std))
    np.testing.assert_allclose(
        density, norm.logpdf(sample, mean, np.exp(log_std)).sum(-1), rtol=1e-4
    )
    np.testing.assert_allclose(
        gaussian_entropy(jnp.asarray(log_std)), norm.entropy(0, np.exp(log_std)).sum(), rtol=1e-5
    )


def test_predictor_is_an_lstm_whose_range_is_the_arena():
    predictor = EvaderPredictor(POLICY.predictor, arena_radius=0.9, arena_height=1.2)
    observation = observation_of(6)
    seen = observation.frames, observation.last_seen
    predicted, parameters = jax.jit(predictor.init_with_output)(jax.random.key(0), *seen)
    assert predicted.shape == (BATCH, 2, 3)
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), parameters["params"])

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    hidden = cell = np.zeros((BATCH, 8))
    for frame in np.moveaxis(np.asarray(observation.frames, np.float64), 1, 0):
        gates = frame @ p["input"]["kernel"] + p["input"]["bias"] + hidden @ p["recurrent"]
        enter, forget, candidate, leave = np.split(gates, 4, axis=1)
        cell = sigmoid(forget + 1) * cell + sigmoid(enter) * np.tanh(candidate)
        hidden = sigmoid(leave) * np.tanh(cell)
    output = (hidden @ p["output"]["kernel"] + p["output"]["bias"]).reshape(BATCH, 2, 3)
    scale = np.array([0.9, 0.9, 0.6])
    start = np.asarray(observation.last_seen)[:, None]
    np.testing.assert_allclose(predicted, start + 0.1 * scale * output, atol=1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: NetworkSettings(features=10, heads=4),
            "features 10 must be a multiple of heads 4",
        ),
        (
            lambda: NetworkSettings(shared_encoder=True, critic_encoder="layers"),
            "critic_encoder layers has no effect",
        ),
        (lambda: PredictorSettings(horizons=(2, 3)), "must start with 1"),
        (lambda: PredictorSettings(windows=5), "windows 5 must be even"),
    ],
)
def test_impossible_settings(make, message):
    with pytest.raises(UserError, match=message):
        make()
