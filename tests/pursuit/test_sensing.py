"""Line of sight: hand-worked cases, symmetry, and a reference that walks along the
segment.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.sensing import line_of_sight, sight_room, within_view

RADIUS = PursuitSettings().pillar_radius


@pytest.fixture(scope="module")
def sight():
    """(B, 2) starts, (B, 2) ends and (B, P, 2) pillars with (B, P) in use, seen from
    above -> (B,) bool.
    """

    def one(start, end, pillars, active):
        lift = jnp.array([0.5])
        position = jnp.concatenate([start, lift])[None]
        target = jnp.concatenate([end, 2 * lift])
        return line_of_sight(PursuitSettings(), position, target, pillars, active)[0]

    return jax.jit(jax.vmap(one))


@pytest.mark.parametrize(
    ("start", "end", "pillar", "active", "clear"),
    [
        ((-0.5, 0), (0.5, 0), (0, 0.05), True, False),
        ((-0.5, 0), (0.5, 0), (0, 0.05), False, True),
        ((-0.5, 0), (0.5, 0), (0, 0.099), True, False),
        ((-0.5, 0), (0.5, 0), (0, 0.101), True, True),
        # the foot point lies behind the target
        ((-0.5, 0), (0.5, 0), (0.55, 0), True, True),
        ((-0.5, 0), (0.5, 0), (-0.55, 0), True, True),  # and behind the pursuer
        ((-0.5, 0), (0.5, 0), (0.45, 0.05), True, False),
        ((-0.5, -0.5), (0.5, 0.5), (0.1, -0.1), True, True),
        ((-0.5, -0.5), (0.5, 0.5), (0.06, -0.06), True, False),
        ((0.2, 0.2), (0.2, 0.2), (0.5, 0.5), True, True),  # above each other
    ],
)
def test_worked_out_by_hand(sight, start, end, pillar, active, clear):
    arrays = [jnp.asarray(x, jnp.float32)[None] for x in (start, end, [pillar])]
    assert bool(sight(*arrays, jnp.array([[active]]))[0]) == clear


def test_it_is_mutual(sight):
    draw = np.random.default_rng(1)
    start, end = jnp.asarray(draw.uniform(-0.9, 0.9, (2, 2000, 2)), jnp.float32)
    pillars = jnp.asarray(draw.uniform(-0.8, 0.8, (2000, 4, 2)), jnp.float32)
    active = jnp.asarray(draw.uniform(size=(2000, 4)) < 0.7)
    there = sight(start, end, pillars, active)
    np.testing.assert_array_equal(there, sight(end, start, pillars, active))
    assert 0.2 < there.mean() < 0.9


def test_room_beside_the_line_is_negative_where_it_is_blocked(sight):
    draw = np.random.default_rng(2)
    start, end = jnp.asarray(draw.uniform(-0.9, 0.9, (2, 500, 2)), jnp.float32)
    pillars = jnp.asarray(draw.uniform(-0.8, 0.8, (500, 4, 2)), jnp.float32)
    active = jnp.asarray(draw.uniform(size=(500, 4)) < 0.7)

    def one(start, end, pillars, active):
        lift = jnp.array([0.5])
        position = jnp.concatenate([start, lift])[None]
        target = jnp.concatenate([end, lift])
        return sight_room(PursuitSettings(), position, target, pillars, active)[0]

    room = jax.jit(jax.vmap(one))(start, end, pillars, active)
    np.testing.assert_array_equal(room >= 0.0, sight(start, end, pillars, active))
    assert RADIUS == pytest.approx(room.max())


@given(points=st.lists(st.floats(-0.9, 0.9), min_size=6, max_size=6))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_against_walking_along_the_segment(sight, points):
    start, end, pillar = np.reshape(points, (3, 2))
    length = np.linalg.norm(end - start)
    assume(length > 0.02)
    share = np.linspace(0, 1, 4001)
    distance = np.linalg.norm(start + share[:, None] * (end - start) - pillar, axis=1)
    nearest = distance.argmin()
    # where the nearest point is at an end or the distance the radius within rounding,
    # both answers are right
    foot = np.dot(pillar - start, end - start) / length**2
    assume(min(abs(foot), abs(1 - foot)) > 1e-3 and abs(distance[nearest] - RADIUS) > 1e-4)
    clear = not (0 < nearest < 4000 and distance[nearest] < RADIUS)
    arrays = [jnp.asarray(x, jnp.float32)[None] for x in (start, end, [pillar])]
    assert bool(sight(*arrays, jnp.ones((1, 1), bool))[0]) == clear


@pytest.mark.parametrize(
    ("target", "angle", "reach", "seen"),
    [
        ((1.0, 0.0, 0.0), 90, 1.1, True),
        ((1.0, 0.0, 0.0), 90, 0.9, False),
        ((0.0, 0.9, 0.0), 178, 1.0, False),  # beside it
        ((0.0, 0.9, 0.0), 182, 1.0, True),
        ((0.7, 0.0, 0.6), 80, 1.0, False),  # a cone is as high as it is wide
        ((0.7, 0.0, 0.6), 82, 1.0, True),
        ((-1.0, 0.0, 0.0), 359, 1.0, False),
        ((-1.0, 0.0, 0.0), 360, 1.0, True),
    ],
)
def test_range_and_cone(target, angle, reach, seen):
    settings = PursuitSettings(sight_angle=angle, sight_range=reach)
    ahead = jnp.array([[1.0, 0.0, 0.0]])
    assert bool(within_view(settings, jnp.zeros((1, 3)), ahead, jnp.array(target))[0]) == seen


@pytest.mark.slow
def test_who_looks_away_captures_unseen():
    """Limits of sight hide the evader from the pursuers, and nothing else."""
    settings = PursuitSettings(
        physics="stops", start_attitude="level", max_pillars=0, min_pillars=0, sight_angle=90.0
    )
    game = Pursuit(settings)
    _, state = game.reset(jax.random.key(0))
    near = jnp.array([[0.1, 0.0, 0.0], [0.5, 0.4, 0.0], [0.5, -0.4, 0.0]])
    # they look along x
    drones = state.drones.replace(position=state.evader_position + near)
    observation, state, _, _, _, info = game.follow(state, jnp.zeros((3, 4)), drones)
    assert bool(info.captured[0]) and not bool(info.seen)
    assert np.all(observation.self_state[:, :3] == -5.0)
    turned = drones.replace(quaternion=jnp.tile(jnp.array([0.0, 0.0, 0.0, 1.0]), (3, 1)))
    assert bool(game.follow(state, jnp.zeros((3, 4)), turned)[-1].seen)
