"""What is left: which regressors may call something unknown, and how much of the gap they must hold."""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.flights.track import Track
from openjax.gap.rest import LIKE_AN_EFFECT, PLAIN, Followed, _happened, _rank, dictionary
from openjax.gap.verdict import LEAST_LEFT, LEAST_PLAIN, UNKNOWN_SHARE, _left


@pytest.fixture(scope="module")
def regressors():
    time = 0.01 * np.arange(800)
    position = np.stack([np.sin(time), np.cos(1.3 * time), 0.6 + 0.3 * np.sin(0.7 * time)], 1)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (800, 1))
    motor = 0.62 + 0.1 * np.sin(np.outer(time, [1.0, 1.1, 1.2, 1.3]))
    return dictionary(
        Track(
            "a", "a", 0.01, time, position, still, np.gradient(position, 0.01, axis=0), np.zeros((800, 3)), None, None, motor,
            4.0 - 0.02 * time, np.zeros((0, 800, 3)),
        )
    )  # fmt: skip


def test_a_place_where_one_stays_says_nothing(regressors):
    place = regressors["force by place x along world x"]
    there = place._replace(values=np.tile([0.5, 0.0, 0.0], (800, 1)))
    assert _happened([place], place.size)
    assert not _happened([there], there.size)


def test_what_effects_of_the_list_do_is_not_strange(regressors):
    known = {n for n, r in regressors.items() if r.rank == LIKE_AN_EFFECT}
    for word in ("force z by thrust", "motor commands", "voltage", "the floor near", "wind along"):
        assert {n for n in regressors if word in n} <= known
    drag = regressors["force x by velocity"]
    assert _rank(drag, ("rotor_drag", "mass")) == LIKE_AN_EFFECT and _rank(drag, ("mass",)) == PLAIN
    plain = {n for n, r in regressors.items() if r.rank == PLAIN}
    assert {"force z by sinking", "torque x by time", "force by place x along world x"} <= plain


def test_a_rest_counts_by_what_it_holds_of_the_gap():
    def left(share, least, named=(), unexplained=0.5):
        parts = SimpleNamespace(
            channels=dict.fromkeys("abcdefghi"),
            gap=SimpleNamespace(after=np.sqrt(1.0 + (1.0 / (1.0 - share) - 1.0) / 9.0)),
            unexplained=SimpleNamespace(value=unexplained),
        )
        return _left(
            parts, Followed(np.array([0.0, 0.0, 0.0, 0.0, 0.0, share]), 30.0), least, UNKNOWN_SHARE, named
        )

    assert left(0.3, LEAST_PLAIN) and not left(0.3, LEAST_LEFT)
    assert left(0.8, LEAST_LEFT) and not left(0.1, LEAST_PLAIN)
    assert left(0.8, LEAST_LEFT, ["mass"], 2.0 * UNKNOWN_SHARE)
    assert not left(0.8, LEAST_LEFT, ["mass"], 0.5 * UNKNOWN_SHARE)
