"""The evader's force against cases worked out by hand, and symmetries of the whole
scene.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import PursuitSettings
from openjax.pursuit.evaders import field_velocity
from openjax.pursuit.sensing import line_of_sight

SPEED = 1.3
MIDDLE = (0.0, 0.0, 0.6)
FAR = (0.0, 0.0, 50.0)  # exerts 0.02 at most


def velocity(
    evader, pursuers=((FAR),), in_sight=None, pillars=((5.0, 5.0),), active=None, **settings
):
    pursuers = jnp.asarray(pursuers)
    pillars = jnp.asarray(pillars)
    in_sight = jnp.zeros(len(pursuers), bool) if in_sight is None else jnp.asarray(in_sight)
    active = jnp.ones(len(pillars), bool) if active is None else jnp.asarray(active)
    if active.shape == (1,) and pillars[0, 0] == 5.0:
        active = jnp.zeros(1, bool)
    return np.asarray(
        field_velocity(
            PursuitSettings(**settings), jnp.asarray(evader), pursuers, in_sight, pillars, active
        )
    )


def along(force):
    """Velocity in the direction of a force."""
    return SPEED * np.asarray(force) / np.linalg.norm(force)


@pytest.mark.parametrize(
    ("scene", "force"),
    [
        (dict(evader=(0.0, 0.0, 0.5)), (0, 0, 1 / 0.5 - 1 / 0.7)),
        (dict(evader=(0.5, 0.0, 0.6)), (-1 / 0.4, 0, 0)),
        (dict(evader=(0.3, 0.4, 0.4)), (-0.6 / 0.4, -0.8 / 0.4, 1 / 0.4 - 1 / 0.8)),
        (
            dict(evader=MIDDLE, pursuers=[(0.3, 0, 0.2)], in_sight=[True]),
            (-0.3 / 0.25, 0, 0.4 / 0.25),
        ),
        (
            dict(evader=(0.3, 0, 0.5), pursuers=[(0.3, -0.5, 0.5)], in_sight=[False]),
            (-1 / 0.6, 0, 2 - 1 / 0.7),
        ),
        (
            dict(
                evader=(0.3, 0, 0.6),
                pursuers=[(0.3, -0.5, 0.6), (0, 0, 0.6)],
                in_sight=[True, False],
            ),
            (-1 / 0.6, 2, 0),
        ),
        (
            dict(evader=(0.3, 0, 0.6), pillars=[(0.3, 0.3), (0.35, 0.0)], active=[True, False]),
            (-1 / 0.6, -1 / 0.2, 0),
        ),
    ],
    ids=["height", "wall", "oblique", "pursuer", "unseen pursuer", "one of two", "active pillar"],
)
def test_forces_worked_out_by_hand(scene, force):
    np.testing.assert_allclose(velocity(**scene), along(force), atol=2e-3)


def test_no_force_in_the_middle_is_no_velocity():
    np.testing.assert_allclose(velocity(MIDDLE), 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("scene", "direction"),
    [
        (dict(evader=(0.0, 0.95, 0.6)), (0, -1, 0)),
        (dict(evader=(0.0, 0.0, 1.25)), (0, 0, -1)),
        (dict(evader=(0.0, 0.0, -0.05)), (0, 0, 1)),
        (dict(evader=(0.3, 0.05, 0.6), pillars=[(0.3, 0.0)], active=[True]), (0, 1, 0)),
        # the push is stronger than any pursuer
        (dict(evader=(0.95, 0.0, 0.6), pursuers=[(0.9, 0, 0.6)], in_sight=[True]), (-1, 0, 0)),
    ],
    ids=["wall", "ceiling", "floor", "pillar", "against a pursuer"],
)
def test_pushed_back_from_where_it_must_not_be(scene, direction):
    np.testing.assert_allclose(velocity(**scene), SPEED * np.asarray(direction), atol=1e-3)


@pytest.fixture(scope="module")
def scenes():
    """400 scenes: evader, 3 pursuers, 5 pillars, pillars in use, as arrays."""
    draw = np.random.default_rng(0)
    middle = draw.uniform([-0.6, -0.6, 0.1], [0.6, 0.6, 1.1], (400, 4, 3))
    pillars = draw.uniform(-0.6, 0.6, (400, 5, 2))
    return (
        jnp.asarray(middle[:, 0], jnp.float32),
        jnp.asarray(middle[:, 1:], jnp.float32),
        jnp.asarray(pillars, jnp.float32),
        jnp.asarray(draw.uniform(size=(400, 5)) < 0.7),
    )


def flee(settings):
    def one(evader, pursuers, pillars, active):
        in_sight = line_of_sight(settings, pursuers, evader, pillars, active)
        return field_velocity(settings, evader, pursuers, in_sight, pillars, active)

    return jax.jit(jax.vmap(one))


def test_turning_the_scene_turns_the_velocity(scenes):
    angle = 0.7
    turn = jnp.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]],
        jnp.float32,
    )

    def turned(x):
        return jnp.matmul(x, turn[: x.shape[-1], : x.shape[-1]].T, precision="highest")

    evader, pursuers, pillars, active = scenes
    flee_all = flee(PursuitSettings())
    before = flee_all(*scenes)
    after = flee_all(turned(evader), turned(pursuers), turned(pillars), active)
    np.testing.assert_allclose(after, turned(before), atol=5e-3)


def test_constant_speed(scenes):
    velocity = np.asarray(flee(PursuitSettings(evader_speed=2.0))(*scenes))
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=-1), 2.0, rtol=1e-3)
