"""Places where an evader can't be reached, where one can work them out by hand."""

import numpy as np

from experiments.evaders.pockets import CELL, Rules, distances, sees
from openjax.pursuit import PursuitSettings

GAME = PursuitSettings()
PURSUERS = np.array([[0.6, 0.0, 0.6]])
EVADER = np.array([-0.3, -0.3, 0.6])
NONE = np.zeros((0, 2))


def test_in_the_open_the_deepest_place_is_where_wall_and_floor_meet():
    """The evader keeps .02 m from both; the pursuer .05 m from the wall and .101 m from
    the floor.
    """
    far = distances(GAME, NONE, PURSUERS, EVADER, Rules(margin=0.05, breaches=True))[1]
    np.testing.assert_allclose(far.max(), np.hypot(0.03, 0.081), atol=2 * CELL)


def test_behind_a_pillar_nobody_is_seen():
    pillar = np.array([[0.0, 0.0]])
    a = np.array([[-0.3, 0.0], [-0.3, 0.2]])
    np.testing.assert_array_equal(
        sees(a, np.array([0.3, 0.0]) + 0 * a, pillar, 0.1), [False, False]
    )
    np.testing.assert_array_equal(sees(a, a + np.array([0.1, 0.0]), pillar, 0.1), [True, True])


def test_a_ring_of_pillars_keeps_pursuers_out_and_the_evader_in():
    """Gaps of .08 m: too narrow for a pursuer, wide enough for the evader, who stays
    inside.
    """
    angle = 2 * np.pi * np.arange(8) / 8
    radius = 0.28 / (2 * np.sin(np.pi / 8))  # of axes .28 m apart
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    evader = np.array([0.0, 0.0, 0.6])
    places, far = distances(GAME, ring, PURSUERS, evader, Rules(margin=0.0, breaches=False))
    at_the_middle = far[np.argmin(np.linalg.norm(places, axis=-1))]
    assert at_the_middle > GAME.capture_radius
    assert np.linalg.norm(places, axis=-1).max() > 0.8, "it may leave through a gap"
