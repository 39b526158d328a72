"""Observation against numbers worked out by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
    np.testing.assert_allclose(observation.privileged[:, 3:6], np.tile([1.3, 0, 0], (3, 1)), atol=1e-6)
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
