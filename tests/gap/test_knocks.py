"""Pushes and changes that nobody announced: told from turbulence and from the sensors' noise, whatever the other channels do."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from openjax.gap.knocks import knocks
from openjax.gap.replay import FORCE, RATES

DT, ROWS = 0.01, 1000
TIME = DT * np.arange(ROWS)


def flights(push=0.0, forgets=0.5, seed=0, twist=0.0):
    """Three tracks of turbulence (1 m/s^2 and rad/s^2, which it forgets within some seconds) and noise, with a `push` (ROWS,)
    along x and a torque `twist` (ROWS,) about y."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(3):
        keep = np.exp(-DT / forgets)
        x = 0.2 * rng.standard_normal((ROWS, 9))
        for axes in (FORCE, RATES):
            driven = rng.standard_normal((ROWS, 3))
            x[:, axes] += lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], driven, axis=0)
        x[:, 6] += push
        x[:, 1] += twist
        out.append(x)
    return [SimpleNamespace(dt=DT, name="flight", motors_logged=True)] * 3, out, np.ones(9)


@pytest.mark.parametrize("forgets", [0.1, 0.5, 2.0])
def test_turbulence_is_no_event(forgets):
    assert not any(knocks(*flights(forgets=forgets, seed=seed)) for seed in range(3))


def test_pushes_and_jets_that_switch_are_found():
    assert knocks(*flights(3.0 * (TIME % 0.9 < 0.07)))
    assert knocks(*flights(3.0 * (TIME % 3.0 < 1.5)))
    assert not knocks(*flights(2.0 * np.sin(2 * np.pi * TIME / 3.0)))  # as strong, but slow
    tracks, disturbed, usable = flights(3.0 * (TIME % 0.9 < 0.07))
    assert not knocks(tracks, [0.01 * x for x in disturbed], usable)  # too weak to matter


def test_a_torque_that_changes_for_good_is_found_with_its_time():
    (found,) = knocks(*flights(twist=8.0 * (TIME > 6.0)))
    assert "about y" in found and "after 6.0 s" in found
    assert not knocks(*flights(twist=2.0 * np.sin(2 * np.pi * TIME / 7.0)))  # comes and goes
    tracks, disturbed, usable = flights(twist=8.0 * (TIME > 6.0))
    assert not knocks(tracks, [0.1 * x for x in disturbed], usable)  # too weak to matter
    usable[RATES] = 0.0
    assert not knocks(tracks, disturbed, usable)


def test_only_sideways_force_tells_pushes_and_only_where_it_was_logged():
    tracks, disturbed, usable = flights()
    for x in disturbed:
        x[:, [0, 3, 8]] += 3.0 * (TIME % 0.9 < 0.07)[:, None]
    assert not knocks(tracks, disturbed, usable)
    tracks, disturbed, usable = flights(3.0 * (TIME % 0.9 < 0.07))
    usable[FORCE] = 0.0
    assert not knocks(tracks, disturbed, usable)
