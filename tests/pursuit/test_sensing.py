"""Line of sight: hand-worked cases, symmetry, and a reference that walks along the segment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from openjax.pursuit import PursuitSettings
from openjax.pursuit.sensing import line_of_sight

RADIUS = PursuitSettings().pillar_radius


@pytest.fixture(scope="module")
def sight():
    """(B, 2) starts, (B, 2) ends and (B, P, 2) pillars with (B, P) in use, seen from above -> (B,)
    bool.
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
        ((-0.5, 0), (0.5, 0), (0.55, 0), True, True),  # the foot point lies behind the target
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


@given(points=st.lists(st.floats(-0.9, 0.9), min_size=6, max_size=6))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_against_walking_along_the_segment(sight, points):
    start, end, pillar = np.reshape(points, (3, 2))
    length = np.linalg.norm(end - start)
    assume(length > 0.02)
    share = np.linspace(0, 1, 4001)
    distance = np.linalg.norm(start + share[:, None] * (end - start) - pillar, axis=1)
    nearest = distance.argmin()
    # where the nearest point is at an end or the distance the radius within rounding, both answers
    # are right
    foot = np.dot(pillar - start, end - start) / length**2
    assume(min(abs(foot), abs(1 - foot)) > 1e-3 and abs(distance[nearest] - RADIUS) > 1e-4)
    clear = not (0 < nearest < 4000 and distance[nearest] < RADIUS)
    arrays = [jnp.asarray(x, jnp.float32)[None] for x in (start, end, [pillar])]
    assert bool(sight(*arrays, jnp.ones((1, 1), bool))[0]) == clear
