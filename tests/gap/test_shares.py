"""Shares against the definition of Shapley, and probabilities that add up."""

import numpy as np
import pytest

from openjax.gap.decision import DECISION
from openjax.gap.probabilities import probabilities
from openjax.gap.shares import shares_of_channels, shares_of_squares

RNG = np.random.default_rng(0)


def test_shares_and_what_is_unexplained_add_up_to_one():
    squares = 1.0 + RNG.random((6, 12, 3)) * np.array([0.1, 8.0, 7.0, 4.0, 2.0, 0.5])[:, None, None]
    values, _ = shares_of_squares(squares, np.full((1, 12), 1.0 / 12), np.array([0.9, 1.0, 0.7]))
    assert values.sum() == pytest.approx(1.0) and values.shape == (1, 4) and (values >= 0.0).all()
    assert values[0, 0] > values[0, 1] > values[0, 2]


def test_one_part_alone_has_all_that_is_explained():
    squares = np.array([1.1, 9.0, 9.0, 9.0, 1.1])[:, None, None] * np.ones((5, 10, 2))
    values, square = shares_of_squares(squares, np.full((1, 10), 0.1), np.full(2, 1.0 / 1.1))
    assert values[0] == pytest.approx([1.0 - 0.1 / 8.0, 0.0, 0.1 / 8.0]) and square[
        0
    ] == pytest.approx([9.0, 1.1])


def test_a_wind_beside_rotors_that_differ_takes_the_whole_of_one_channel_and_little_of_all():
    """Rates are 900 floors off by the rotors, velocity is 9 by the wind: the first row has both
    effects, the next ones none, none but the sensors, one without each part.
    """
    rates = [1.0, 901.0, 901.0, 901.0, 1.0, 1.0]
    velocity = [1.0, 10.0, 10.0, 1.0, 10.0, 1.4]
    squares = np.array([rates, velocity]).T[:, None]
    values, _ = shares_of_squares(squares, np.ones((1, 1)), np.ones(2))
    assert values[0, 1] < DECISION.form_error
    channels, parts = shares_of_channels(squares[:, 0], np.ones(2))
    assert channels.tolist() == [0, 1] and parts == pytest.approx([1.0, 1.0])
    # less than a floor is none of it, however little else there is
    weak = 1.0 + (squares[:, 0] - 1.0) * np.array([1.0, 0.1])
    assert shares_of_channels(weak, np.ones(2))[1] == pytest.approx([1.0, 0.0])


def test_without_a_gap_all_there_is_are_the_sensors():
    squares = np.ones((4, 10, 2))
    values, square = shares_of_squares(squares, np.full((1, 10), 0.1), np.ones(2))
    assert values[0] == pytest.approx([1.0, 0.0]) and square == pytest.approx(np.ones((1, 2)))


def test_probabilities_add_up_and_follow_the_words():
    weights = {frozenset({"mass"}): 0.9, frozenset(): 0.1}
    found = probabilities({"mass": 0.9}, {"mass": 1.0, "unexplained": 0.0}, 0.05, weights)
    assert sum(found.values()) == pytest.approx(1.0) and max(found, key=found.get) == "mass"
    nothing = probabilities({}, {}, 0.05, {frozenset(): 1.0})
    odds = 0.95 / 0.05
    least = min(nothing.values())
    assert (nothing["none"] - least) / (nothing["unknown"] - least) == pytest.approx(odds)
    assert sum(nothing.values()) == pytest.approx(1.0)
    assert nothing["none"] < DECISION.reliability + least
