"""Sudden pushes: told from turbulence and from the accelerometer's noise, whatever the other channels do."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from openjax.gap.knocks import knocks
from openjax.gap.replay import FORCE

DT, ROWS = 0.01, 1200


def flights(push=None, forgets=0.5, seed=0):
    """Three tracks of turbulence (1 m/s^2, which it forgets within some seconds) and noise, with a `push` (ROWS,) along x."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(3):
        keep = np.exp(-DT / forgets)
        x = 0.2 * rng.standard_normal((ROWS, 9))
        x[:, FORCE] += lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal((ROWS, 3)), axis=0)
        if push is not None:
            x[:, 6] += push
        out.append(x)
    return [SimpleNamespace(dt=DT)] * 3, out, np.ones(9)


@pytest.mark.parametrize("forgets", [0.1, 0.5, 2.0])
def test_turbulence_has_no_knocks(forgets):
    assert not any(knocks(*flights(forgets=forgets, seed=seed)) for seed in range(5))


def test_knocks_and_jets_that_switch_are_found():
    time = DT * np.arange(ROWS)
    assert knocks(*flights(3.0 * (time % 0.9 < 0.07)))
    assert knocks(*flights(2.0 * (time % 3.0 < 1.5)))
    assert not knocks(*flights(2.0 * np.sin(2 * np.pi * time / 3.0)))  # as strong, but slow
    tracks, disturbed, usable = flights(3.0 * (time % 0.9 < 0.07))
    assert not knocks(tracks, [0.01 * x for x in disturbed], usable)  # too weak to matter


def test_only_sideways_force_counts_and_only_where_it_was_logged():
    time = DT * np.arange(ROWS)
    tracks, disturbed, usable = flights()
    for x in disturbed:
        x[:, [0, 3, 8]] += 3.0 * (time % 0.9 < 0.07)[:, None]
    assert not knocks(tracks, disturbed, usable)
    tracks, disturbed, usable = flights(3.0 * (time % 0.9 < 0.07))
    usable[FORCE] = 0.0
    assert not knocks(tracks, disturbed, usable)
