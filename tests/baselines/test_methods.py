"""The methods in situations made by hand, and what must hold for all of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.baselines import METHODS
from openjax.baselines.angelani import AngelaniParameters, angelani
from openjax.baselines.apf import ApfParameters, apf, forces
from openjax.baselines.dacoop import LEARNED, field_parameters
from openjax.baselines.janosov import JanosovParameters, janosov
from openjax.baselines.parameters import best, ranges
from openjax.baselines.surroundings import Craft, Surroundings, surroundings
from openjax.pursuit import Pursuit, PursuitSettings, Task, turn_task

CRAFT = Craft()
FAR = 9.0


def situation(position, target, velocity=None, target_velocity=(0.0, 0.0, 0.0), pillars=()):
    """Surroundings of N pursuers at (N, 3) in the middle of a wide, high arena with
    pillars (x, y) of radius 0.1 m.
    """
    position = np.asarray(position, np.float32)
    n = len(position)
    velocity = (
        np.zeros((n, 3), np.float32) if velocity is None else np.asarray(velocity, np.float32)
    )
    index = [[j for j in range(n) if j != i] for i in range(n)]
    index = np.array(index, int).reshape(n, n - 1)
    normal = np.zeros((n, 4, 2), np.float32)
    distance = np.full((n, 4), FAR, np.float32)
    normal[:, :, 0] = 1.0
    for k, pillar in enumerate(pillars):
        offset = position[:, :2] - np.asarray(pillar)
        across = np.linalg.norm(offset, axis=-1, keepdims=True)
        normal[:, k], distance[:, k] = offset / across, across[:, 0] - 0.1
    known = Surroundings(
        position=position,
        velocity=velocity,
        target=np.broadcast_to(np.float32(target), (n, 3)),
        target_velocity=np.broadcast_to(np.float32(target_velocity), (n, 3)),
        from_others=position[:, None] - position[index],
        from_others_velocity=velocity[:, None] - velocity[index],
        team_velocity=np.broadcast_to(velocity.mean(axis=0), (n, 3)),
        obstacle_normal=normal,
        obstacle_distance=distance,
        floor_distance=np.full(n, FAR, np.float32),
        ceiling_distance=np.full(n, FAR, np.float32),
    )
    return jax.tree.map(jnp.asarray, known)


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


# stack gathers on the axis first
@pytest.mark.parametrize("name", sorted({*METHODS} - {"stack"}))
def test_a_lone_pursuer_flies_straight_to_a_resting_evader(name):
    method = METHODS[name]
    known = situation([[0.0, 0.0, 1.0]], [0.3, -0.4, 1.2])
    velocity = jax.jit(lambda known: method.rule(CRAFT, method.kind(), known))(known)[0]
    np.testing.assert_allclose(velocity, CRAFT.speed * unit([0.3, -0.4, 0.2]), atol=1e-3)


def test_angelani_adds_attraction_alignment_and_repulsion():
    parameters = AngelaniParameters(alignment=0.5, repulsion=2.0, repulsion_range=0.3, width=0.1)
    known = situation(
        [[0.0, 0.0, 1.0], [0.0, 0.4, 1.0]],
        [1.0, 0.0, 1.0],
        velocity=[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]],
    )
    # one Fermi function a tenth of a metre beyond its range, in units of its width: 1 /
    # (1 + e)
    expected = np.array([1.0, 0.5 - 2.0 / (1.0 + np.e), 0.0])
    np.testing.assert_allclose(
        angelani(CRAFT, parameters, known)[0], CRAFT.speed * unit(expected), atol=1e-4
    )


def test_janosov_leads_a_moving_evader_and_spreads():
    parameters = JanosovParameters(
        prediction_time=0.2,
        chase_friction=0.0,
        interaction=0.5,
        interaction_range=1.0,
        interaction_friction=0.0,
    )
    lone = situation([[0.0, 0.0, 1.0]], [1.0, 0.0, 1.0], target_velocity=[0.0, 1.3, 0.0])
    expected = unit([1.0, 0.2 * 1.3, 0.0])
    np.testing.assert_allclose(
        janosov(CRAFT, parameters, lone)[0], CRAFT.speed * expected, atol=1e-4
    )
    near = situation([[0.9, 0.0, 1.0]], [1.0, 0.0, 1.0], target_velocity=[0.0, 1.3, 0.0])
    ahead = 0.1 / 1.3  # it would be there before the prediction's end
    expected = unit([0.1, ahead * 1.3, 0.0])
    np.testing.assert_allclose(
        janosov(CRAFT, parameters, near)[0], CRAFT.speed * expected, atol=1e-4
    )
    two = situation([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0]], [1.0, 0.0, 1.0])
    expected = unit([1.0, -0.5, 0.0])
    np.testing.assert_allclose(
        janosov(CRAFT, parameters, two)[0], CRAFT.speed * expected, atol=1e-4
    )


def test_janosovs_walls_stop_a_pursuer_at_their_surface_and_are_not_felt_beyond_their_range():
    parameters = JanosovParameters(wall_range=0.2, wall=1.0)
    at_surface = situation([[-0.1, 0.0, 1.0]], [1.0, 0.0, 1.0], pillars=[(0.0, 0.0)])
    np.testing.assert_allclose(janosov(CRAFT, parameters, at_surface)[0], 0.0, atol=1e-4)
    half_way = situation([[-0.2, 0.0, 1.0]], [1.0, 0.0, 1.0], pillars=[(0.0, 0.0)])
    np.testing.assert_allclose(
        janosov(CRAFT, parameters, half_way)[0], [0.5 * CRAFT.speed, 0, 0], atol=1e-3
    )
    beyond = situation([[-0.31, 0.0, 1.0]], [1.0, 0.0, 1.0], pillars=[(0.0, 0.0)])
    np.testing.assert_allclose(
        janosov(CRAFT, parameters, beyond)[0], [CRAFT.speed, 0, 0], atol=1e-4
    )


def test_the_fields_forces_in_closed_form():
    parameters = ApfParameters(repulsion=1e-3, influence=0.3, margin=0.1, balance=0.1)
    # 0.2 m from a pillar's surface: 0.1 m beyond the margin; others 0.34 m apart: 0.2 m
    # beyond theirs
    known = situation(
        [[-0.3, 0.0, 1.0], [-0.3, 0.34, 1.0]], [0.0, 2.0, 1.0], pillars=[(0.0, 0.0), (0.0, -4.0)]
    )
    field = forces(parameters, known)
    push = 1e-3 * (1 / 0.1 - 1 / 0.3) / 0.1**2
    np.testing.assert_allclose(field.repulsion[0], [-push, 0.0, 0.0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(field.individual[0], [0.0, 0.5 - 0.1 / 0.2, 0.0], atol=1e-5)
    # between two pillars both push
    between = situation([[0.0, 0.0, 1.0]], [0.0, 2.0, 1.0], pillars=[(0.3, 0.0), (-0.3, 0.0)])
    np.testing.assert_allclose(forces(parameters, between).repulsion[0], 0.0, atol=1e-5)
    nearer = situation([[-0.27, 0.0, 1.0], [-0.27, 0.24, 1.0]], [0.0, 2.0, 1.0])
    np.testing.assert_allclose(
        forces(parameters, nearer).individual[0], [0.0, -0.5, 0.0], atol=1e-4
    )


@pytest.mark.parametrize("drift", [-1.0, 1.0])
def test_in_front_of_a_pillar_the_field_follows_its_wall_to_the_side_it_flies_to(drift):
    parameters = ApfParameters(repulsion=0.01, influence=0.3, margin=0.07, balance=0.1)
    known = situation(
        [[-0.2, 0.0, 1.0]],
        [1.0, 0.0, 1.0],
        velocity=[[0.3, 0.2 * drift, 0.0]],
        pillars=[(0.0, 0.0)],
    )
    field = forces(parameters, known)
    assert float(jnp.sum((field.attraction + field.repulsion) * field.attraction)) < 0.0
    np.testing.assert_allclose(
        apf(CRAFT, parameters, known)[0], [0.0, drift * CRAFT.speed, 0.0], atol=1e-3
    )
    # beside the pillar it is no longer in the way
    past = situation([[0.2, 0.25 * drift, 1.0]], [1.0, 0.25 * drift, 1.0], pillars=[(0.0, 0.0)])
    assert apf(CRAFT, parameters, past)[0, 0] > 0.5 * CRAFT.speed


def test_inside_the_margin_it_turns_away_from_the_obstacle_as_well():
    parameters = ApfParameters(repulsion=0.01, influence=0.3, margin=0.12, balance=0.1)
    known = situation(
        [[-0.2, 0.0, 1.0]], [1.0, 0.0, 1.0], velocity=[[0.3, 0.2, 0.0]], pillars=[(0.0, 0.0)]
    )
    expected = CRAFT.speed * unit([-1.0, 1.0, 0.0])
    np.testing.assert_allclose(apf(CRAFT, parameters, known)[0], expected, atol=1e-3)


def test_following_a_wall_a_pursuer_yields_to_others_that_push_harder_than_the_evader_pulls():
    parameters = ApfParameters(repulsion=0.01, influence=0.3, margin=0.07, balance=0.5)
    known = situation(
        [[-0.2, 0.0, 1.0], [-0.2, 0.3, 1.0]],
        [1.0, 0.0, 1.0],
        velocity=[[0.3, 0.2, 0.0], [0.0, 0.0, 0.0]],
        pillars=[(0.0, 0.0)],
    )
    assert float(jnp.linalg.norm(forces(parameters, known).individual[0])) > 1.0
    np.testing.assert_allclose(apf(CRAFT, parameters, known)[0, 1], -CRAFT.speed, atol=1e-3)


@pytest.mark.parametrize("name", list(METHODS))
def test_turning_the_world_turns_the_velocities(name):
    settings = PursuitSettings(physics="rigid")
    environment = Pursuit(settings)
    task = Task(
        pursuer_position=jnp.array([[0.3, 0.1, 0.5], [0.6, -0.3, 0.6], [0.2, -0.5, 0.7]]),
        evader_position=jnp.array([-0.3, 0.1, 0.55]),
        pillar_position=jnp.array([[0.0, 0.4], [0.1, -0.25], [-0.5, -0.4], [0.5, 0.5], [0.0, 0.0]]),
        pillar_active=jnp.array([True, True, True, True, False]),
    )
    key = jax.random.key(3)
    turned = turn_task(key, task)
    angle = np.arctan2(*np.asarray(turned.evader_position)[1::-1]) - np.arctan2(0.1, -0.3)
    method = METHODS[name]
    craft = Craft.of(environment)

    @jax.jit
    def desired(task):
        observation, _ = environment.reset_to(jax.random.key(0), task)
        return method.rule(craft, best(name, method.kind), surroundings(craft, observation))

    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    plain = np.asarray(desired(task))
    other = np.asarray(desired(turned))
    np.testing.assert_allclose(other[:, :2], plain[:, :2] @ rotation.T, atol=1e-4)
    np.testing.assert_allclose(other[:, 2], plain[:, 2], atol=1e-4)


def test_the_found_sets_lie_within_their_ranges():
    for name, method in METHODS.items():
        found = best(name, method.kind)
        for field, (low, high) in ranges(method.kind).items():
            assert 0.999 * low <= float(getattr(found, field)) <= 1.001 * high


def test_dacoops_outputs_span_the_ranges_of_the_field():
    ends = field_parameters(jnp.array([[-1.0, 1.0], [1.0, -1.0]]))
    for i, name in enumerate(LEARNED):
        low, high = ranges(ApfParameters)[name]
        expected = (low, high) if i == 0 else (high, low)
        np.testing.assert_allclose(getattr(ends, name), expected, rtol=1e-4)
