"""Torques that no push could make: told from turbulence, whose lever is short, and from what motors have wrong."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from openjax.gap.levers import torques
from openjax.gap.replay import FORCE, RATES, VELOCITY

DT, ROWS = 0.01, 1000
TIME = DT * np.arange(ROWS)
VEHICLES = [SimpleNamespace(inertia=np.array([2e-5, 2e-5, 3e-5]), mass=0.035)]


def flights(torque=0.0, turned=None, push=0.05, lever=0.008, noise=0.01, axis=2, seed=0):
    """Three tracks: turbulence of `push` (m/s^2) with a `lever` (m), noise (rad/s) of the gyroscope, a `torque` (ROWS,) rad/s^2
    about an axis; `turned` (ROWS,): what the vehicle did there, by default what a loop lets a disturbance do."""
    rng, disturbed, whole = np.random.default_rng(seed), [], []
    for _ in range(3):
        gust = push * lfilter([0.3], [1.0, -0.95], rng.standard_normal((ROWS, 3)), axis=0)
        x = np.zeros((ROWS, 9))
        x[:, FORCE] = x[:, VELOCITY] = gust
        x[:, RATES] = np.roll(gust, 1, 1) * lever * VEHICLES[0].mass / VEHICLES[0].inertia
        x[:, axis] += torque
        x[:, RATES] += np.gradient(noise * rng.standard_normal((ROWS, 3)), DT, axis=0)
        did = 0.1 * x[:, RATES]
        if turned is not None:
            did[:, axis] = turned + x[:, axis]
        disturbed.append(x)
        whole.append(did)
    tracks = [SimpleNamespace(dt=DT, motors_logged=True, missing=None)] * 3
    return tracks, disturbed, whole, np.ones(9), VEHICLES


@pytest.mark.parametrize("seed", range(3))
def test_gusts_and_the_gyroscopes_noise_are_nothing(seed):
    assert not torques(*flights(seed=seed))
    assert not torques(*flights(noise=0.05, seed=seed))


@pytest.mark.parametrize("axis", range(3))
def test_slow_and_quick_disturbances_are_found_in_any_form(axis):
    for torque in (
        4.0 * np.sin(2 * np.pi * 0.8 * TIME),
        30.0 * (TIME % 0.7 < 0.08),
        5.0 * np.sign(np.sin(TIME)),
    ):
        (found,) = torques(*flights(torque, axis=axis))
        assert f"about {'xyz'[axis]}" in found


def test_what_motors_have_wrong_is_no_disturbance():
    work = 20.0 * np.sin(2 * np.pi * 1.5 * TIME)
    late = np.interp(TIME - 0.02, TIME, work)
    assert not torques(*flights(0.2 * work, turned=work))
    assert not torques(*flights(work - late, turned=late))


def test_a_torque_counts_by_the_push_beside_it():
    tracks, disturbed, *more = flights(4.0 * np.sin(2 * np.pi * 0.8 * TIME))
    for x in disturbed:
        x[:, FORCE] *= 30.0
        x[:, VELOCITY] *= 30.0
    assert not torques(tracks, disturbed, *more)


def test_nothing_is_said_without_gyroscope_or_motors():
    tracks, disturbed, turned, usable, vehicles = flights(4.0 * np.sin(TIME))
    assert not torques(tracks, disturbed, turned, np.r_[np.zeros(3), np.ones(6)], vehicles)
    made = [SimpleNamespace(dt=DT, motors_logged=False, missing=None)] * 3
    assert not torques(made, disturbed, turned, usable, vehicles)


def test_rows_that_are_missing_tell_nothing():
    glitch = 40.0 * np.isin(np.arange(ROWS) // 10, (20, 45, 70))
    tracks, *more = flights(glitch)
    assert torques(tracks, *more)
    tracks = [SimpleNamespace(dt=DT, motors_logged=True, missing=glitch > 0.0)] * 3
    assert not torques(tracks, *more)
