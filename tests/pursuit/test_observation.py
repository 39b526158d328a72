"""Observation against numbers worked out by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.interfaces.flat import flat_observation
from openjax.policy.actor_critic import own_features
from openjax.pursuit import Pursuit, PursuitSettings, Task
from openjax.pursuit.observation import frame, observe, rotation_axes
from openjax.vehicle import hover_state, load_vehicle

POSITION = np.array([[0.4, 0.0, 0.5], [0.0, 0.2, 0.7], [-0.2, -0.4, 0.6]], np.float32)
TURNED = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], np.float32)  # yaw by 90 degrees
ROLLED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0], np.float32)  # roll by 90 degrees
EVADER = np.array([-0.6, 0.1, 0.6], np.float32)
PILLARS = np.array([[0.0, 0.0], [0.4, 0.3], [-0.4, -0.1], [0.5, 0.5]], np.float32)


_observe = functools.partial(jax.jit, static_argnums=0)(observe)


def observed(seen=True, active=(True,) * 4, pillars=PILLARS, quaternion=TURNED, **changes):
    settings = PursuitSettings(episode_length=800, **changes)
    quaternion = jnp.asarray(np.stack([[1, 0, 0, 0], quaternion, [1, 0, 0, 0]]), jnp.float32)
    velocity = jnp.asarray(0.1 * np.arange(9).reshape(3, 3), jnp.float32)
    drones = hover_state(load_vehicle(), jnp.asarray(POSITION), quaternion, velocity)
    task = Task(
        pursuer_position=jnp.asarray(POSITION),
        evader_position=jnp.asarray(EVADER),
        pillar_position=jnp.asarray(pillars),
        pillar_active=jnp.asarray(active),
    )
    _, state = jax.jit(Pursuit(settings).reset_to)(jax.random.key(0), task)
    state = state.replace(
        step=jnp.int32(200),
        drones=drones,
        evader_velocity=jnp.array([1.3, 0.0, 0.0]),
        in_sight=jnp.full(3, seen),
        last_seen=jnp.array([0.1, 0.2, 0.3]),
    )
    return _observe(settings, state, drones)


def test_own_part():
    own = np.asarray(observed().self_state)
    assert own.shape == (3, 3 + 4 + 3 + 3 + 3 + 4)  # 35 with five predicted positions
    np.testing.assert_allclose(own[:, :3], POSITION - EVADER, atol=1e-6)
    np.testing.assert_allclose(own[1, 3:7], TURNED, atol=1e-6)
    np.testing.assert_allclose(own[1, 7:10], [0.3, 0.4, 0.5], atol=1e-6)
    np.testing.assert_allclose(own[0, 10:16], [1, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(own[1, 10:16], [0, 1, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(own[:, 16:], 0.25, atol=1e-6)


def test_unseen_evader_is_marked_for_all_but_not_for_the_critic():
    observation = observed(seen=False)
    np.testing.assert_array_equal(observation.self_state[:, :3], -5.0)
    np.testing.assert_allclose(observation.privileged[:, :3], POSITION - EVADER, atol=1e-6)
    np.testing.assert_allclose(
        observation.privileged[:, 3:6], np.tile([1.3, 0, 0], (3, 1)), atol=1e-6
    )
    np.testing.assert_array_equal(observation.privileged[:, 9], 0.0)
    np.testing.assert_array_equal(observed().privileged[:, 9], 1.0)


def test_options_change_the_own_part():
    assert observed(observe_time=False).self_state.shape == (3, 16)
    own = observed(observe_position=True).self_state
    np.testing.assert_allclose(own[:, -3:], POSITION, atol=1e-6)


def test_others_are_relative_and_in_order():
    others = np.asarray(observed().others)
    assert others.shape == (3, 2, 3)
    for i, (first, second) in enumerate([(1, 2), (0, 2), (0, 1)]):
        np.testing.assert_allclose(others[i, 0], POSITION[i] - POSITION[first], atol=1e-6)
        np.testing.assert_allclose(others[i, 1], POSITION[i] - POSITION[second], atol=1e-6)


@pytest.mark.parametrize(
    ("active", "orders"),
    [
        ((True,) * 4, [(1, 0, 3), (0, 1, 2), (2, 0, 1)]),
        ((True, False, True, True), [(0, 3, 2), (0, 2, 3), (2, 0, 3)]),
        ((True, False, True, False), [(0, 2), (0, 2), (2, 0)]),
        ((False,) * 4, [(), (), ()]),
    ],
)
def test_nearest_pillars_come_first(active, orders):
    observation = observed(active=active)
    for i, order in enumerate(orders):
        expected = np.full((3, 5), -5.0)
        for slot, pillar in enumerate(order):
            expected[slot] = [*(POSITION[i, :2] - PILLARS[pillar]), POSITION[i, 2] - 0.6, 1.2, 0.1]
        np.testing.assert_allclose(observation.pillars[i], expected, atol=1e-6)
        np.testing.assert_array_equal(observation.pillar_seen[i], np.arange(3) < len(order))


def test_fewer_slots_than_are_observed():
    observation = observed(pillars=PILLARS[:1], active=(True,))
    np.testing.assert_array_equal(observation.pillar_seen, [[True, False, False]] * 3)
    np.testing.assert_array_equal(observation.pillars[:, 1:], -5.0)


def test_body_axes():
    roll = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0], np.float32)
    pitch = np.array([np.cos(0.1), 0, np.sin(0.1), 0], np.float32)
    x, z = rotation_axes(jnp.asarray(np.stack([roll, pitch])))
    np.testing.assert_allclose(z, [[0, -1, 0], [np.sin(0.2), 0, np.cos(0.2)]], atol=1e-6)
    np.testing.assert_allclose(x, [[1, 0, 0], [np.cos(0.2), 0, -np.sin(0.2)]], atol=1e-6)


@pytest.mark.parametrize("seen", [True, False])
def test_frame_of_the_history(seen):
    settings = PursuitSettings(episode_length=400)
    numbers = frame(
        settings,
        jnp.int32(100),
        jnp.asarray(POSITION),
        jnp.asarray(EVADER),
        jnp.array([1.0, 2.0, 3.0]),
        jnp.asarray(seen),
    )
    evader = [*EVADER, 1, 2, 3] if seen else [-5] * 6
    np.testing.assert_allclose(numbers, [0.25, *evader, *POSITION.ravel()], atol=1e-6)
    assert numbers.shape == (settings.frame_size,)


def test_in_its_heading_a_turned_game_looks_the_same():
    settings = PursuitSettings(
        physics="rigid",
        observe_in="heading",
        observe_position=True,
        observe_history=2,
        min_pillars=0,
    )
    environment = Pursuit(settings)
    step = jax.jit(environment.step)
    key = jax.random.key(1)
    observation, state = jax.jit(environment.reset)(key)
    angle = 2.5
    turn = jnp.array(
        [
            [np.cos(angle), -np.sin(angle), 0.0],
            [np.sin(angle), np.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ],
        jnp.float32,
    )
    w, x, y, z = state.drones.quaternion.T
    c = np.cos(angle / 2)
    s = np.sin(angle / 2)
    quaternion = jnp.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
    history = state.own_history.at[..., 3:6].set(rotation_axes(quaternion)[0])
    history = history.at[..., 6:9].set(rotation_axes(quaternion)[1])
    turned = state.replace(
        task=state.task.replace(pillar_position=state.task.pillar_position @ turn[:2, :2].T),
        drones=state.drones.replace(position=state.drones.position @ turn.T, quaternion=quaternion),
        evader_position=turn @ state.evader_position,
        last_seen=turn @ state.last_seen,
        own_history=history,
    )
    for i in range(5):
        action = 0.3 * jax.random.normal(jax.random.key(i), (3, 4)).at[:, 0].set(0.3)
        observation, state, *_ = step(key, state, action)
        other, turned, *_ = step(key, turned, action)
    assert np.abs(turned.drones.position - state.drones.position).max() > 0.1
    for name in ("self_state", "others", "pillars", "privileged"):
        np.testing.assert_allclose(
            getattr(other, name), getattr(observation, name), atol=1e-5, err_msg=name
        )
    np.testing.assert_allclose(flat_observation(other), flat_observation(observation), atol=1e-5)
    predicted = jax.random.normal(key, (2, 3))
    np.testing.assert_allclose(
        own_features(other, predicted @ turn.T), own_features(observation, predicted), atol=1e-5
    )
    # the quaternion is that of the axes: yaw is gone, roll and pitch stay
    own = other.self_state
    for seen, axis in zip(rotation_axes(own[:, 3:7]), (own[:, 10:13], own[:, 13:16]), strict=True):
        np.testing.assert_allclose(seen, axis, atol=1e-5)
    np.testing.assert_allclose(own[:, 11], 0.0, atol=1e-6)
