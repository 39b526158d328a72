"""Lines in the rest: found where they are motion, not where one sensor may shake by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.replay import FORCE, RATES, VELOCITY
from openjax.gap.spectral_lines import lines

DT, ROWS = 0.01, 900


def rest(channels=(), frequency=5.0, size=1.0):
    """Two tracks of coloured noise, with a line of `size` noise deviations in some channels."""
    rng, out = np.random.default_rng(0), []
    for _ in range(2):
        white = rng.standard_normal((ROWS + 1, 9))
        x = white[1:] + 0.8 * white[:-1]
        for channel in channels:
            x[:, channel] += size * np.sin(2 * np.pi * frequency * DT * np.arange(ROWS))[:, None]
        out.append(x)
    return [SimpleNamespace(dt=DT)] * 2, out, np.ones(9)


def test_noise_has_no_line():
    assert lines(*rest()) == ()


@pytest.mark.parametrize("channels", [(VELOCITY,), (VELOCITY, FORCE)])
def test_a_line_of_the_motion_is_found_at_its_frequency(channels):
    (found,) = lines(*rest(channels))
    assert "5.0 Hz" in found


def test_who_flies_circles_has_no_line_at_their_rhythm():
    tracks, disturbed, usable = rest((VELOCITY,), frequency=2.0)
    time = DT * np.arange(ROWS)
    circle = np.stack([np.cos(2 * np.pi * time), np.sin(2 * np.pi * time), 0.0 * time], 1)
    assert lines(tracks, disturbed, usable)
    assert lines([SimpleNamespace(dt=DT, velocity=circle)] * 2, disturbed, usable) == ()


def test_a_sensor_that_shakes_by_itself_is_no_motion():
    assert lines(*rest((FORCE,), size=3.0)) == ()
    assert lines(*rest((RATES,), size=0.5)) == ()
    assert lines(*rest((VELOCITY,), frequency=15.0)) == ()
