"""An evader that learns gets away where it is known that one can, and the reference of
the study is right.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import PursuitSettings
from tests.learning.known_games import against_stack, longest

pytestmark = pytest.mark.slow


def test_outside_stacks_bound_one_learns_to_get_away():
    found = against_stack(0.25, 2_000_000, learners=1)
    assert found["learned"][0] < 0.5, found


def test_what_is_best_against_one_pursuer_is_the_closed_form():
    settings = PursuitSettings(max_speed=1.0, evader_speed=0.8, episode_length=400)
    distance = np.array([0.4, 0.6, 0.9])
    exact = (distance - settings.capture_radius) / (settings.max_speed - settings.evader_speed)
    pursuers = jnp.stack([distance, np.zeros(3)], axis=-1)[:, None]
    np.testing.assert_allclose(longest(settings, pursuers), exact, atol=1.5 * settings.time_step)
