"""The residual check: noise passes, what follows the state or swings is found, p-values are those of the calibration."""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.model.whitening import Noise
from openjax.gap.residual import conformal_p, dependence

ROWS, DT = 1500, 0.01


@pytest.fixture
def replay():
    """Two tracks with white noise in all channels, and a residual of each."""
    rng = np.random.default_rng(0)
    tracks = [
        SimpleNamespace(
            dt=DT,
            time=DT * np.arange(ROWS),
            body_rates=rng.standard_normal((ROWS, 3)),
            motor=0.6 + 0.05 * rng.standard_normal((ROWS, 4)),
            quaternion=None,
            position=np.cumsum(rng.standard_normal((ROWS, 3)), 0) * 0.02,
            velocity=None,
            voltage=None,
            neighbours=np.zeros((0, ROWS, 3)),
        )
        for _ in range(2)
    ]
    plain = [Noise(axes, np.ones(1), np.ones(1), 1.0) for axes in ((0, 1), (2,), (3, 4), (5,), (6, 7), (8,))]
    usable = np.ones(9)
    found = SimpleNamespace(tracks=tracks, noises=plain, usable=usable, heard=np.ones(6))
    return found, [rng.standard_normal((ROWS, 9)) for _ in tracks]


def test_noise_depends_on_nothing(replay):
    found, residuals = replay
    assert max(dependence(found, residuals))[0] < 10.0


def test_a_push_that_follows_the_place_is_found_and_where(replay):
    found, residuals = replay
    for track, residual in zip(found.tracks, residuals, strict=True):
        residual[:, 5] += np.cumsum(2.0 * np.sin(3.0 * track.position[:, 0])) * DT * 5.0
    value, words, axis, share = max(dependence(found, residuals))
    assert value > 50.0 and words == "force z depends on the place" and axis == 5 and 0.0 < share < 1.0


@pytest.mark.parametrize("named", [True, False])
def test_p_values_fall_with_the_statistic(named):
    values = [conformal_p(v, named) for v in (0.0, 0.1, 1.0, 100.0)]
    assert values[0] > 0.9 and values == sorted(values, reverse=True) and values[-1] < 0.01
