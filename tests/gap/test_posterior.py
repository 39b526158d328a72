"""The posterior over sets of causes against draws of its own model, and the torques'
causes on responses whose truth is known.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.identification.changes import change_of
from openjax.gap.identification.estimates import ESTIMATED, EffectEstimates
from openjax.gap.identification.search import TorqueFit
from openjax.gap.identification.torque_causes import TORQUES, torques_of
from openjax.gap.model.library import ABSENT, PLACE
from openjax.gap.posterior import Cause, Estimate, explain
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()


def test_weights_and_intervals_are_those_of_draws_from_the_model():
    rng = np.random.default_rng(0)
    names = ("a", "b", "c", "d")
    causes = [
        Cause(n, rng.standard_normal((4, 1)), np.array([[2.0]]), np.log(0.3 / 0.7)) for n in "xyz"
    ]
    root = 0.3 * rng.standard_normal((4, 4)) + 0.4 * np.eye(4)
    said, acts, inside = [], [], []
    for _ in range(1500):
        present = rng.random(3) < 0.3
        sizes = np.sqrt(2.0) * rng.standard_normal(3) * present
        q = sum(c.loads[:, 0] * s for c, s in zip(causes, sizes, strict=True))
        found = explain(Estimate(names, q + root @ rng.standard_normal(4), root @ root.T), causes)
        for k, cause in enumerate(causes):
            said.append(sum(e.weight for e in found if cause.name in e.sizes))
            acts.append(present[k])
        true = next(e for e in found if set(e.sizes) == {"xyz"[k] for k in np.flatnonzero(present)})
        for k in np.flatnonzero(present):
            mean, covariance = true.sizes["xyz"[k]]
            inside.append(abs(mean[0] - sizes[k]) < 1.645 * covariance[0, 0] ** 0.5)
    said, acts = np.array(said), np.array(acts)
    for low, high in ((0.0, 0.2), (0.2, 0.6), (0.6, 1.01)):
        chosen = (said >= low) & (said < high)
        assert said[chosen].mean() == pytest.approx(acts[chosen].mean(), abs=0.05)
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)


def identified(error=0.02, **values):
    """An identification of the nominal vehicle but for the `values`."""
    place = {"up": 0, "down": 1, "delay": 2, "roll": 3, "pitch": 4, "yaw": 5, "damping": 6}
    up = float(VEHICLE.motor_time_constant)
    value = np.array([up, up * float(VEHICLE.motor_slowdown_ratio), 0.0, 1, 1, 1, 0, 0, 0], float)
    for name, number in values.items():
        value[place[name]] = number
    sizes = np.array([0.002, 0.002, 0.001, *[error] * 3, 0.2, 0.2, 0.001])
    fit = TorqueFit(value, np.diag(sizes**2), 0.0, [], None, np.full(3, 50.0), 0.0 * sizes)
    extra, gains = value[:2] - np.array([up, up]), [1 / value[3], 1 / value[4], value[5]]
    scale = np.array([0.002, 0.002, *error * np.array(gains)])
    estimates = EffectEstimates(
        ESTIMATED, np.concatenate([extra, gains]), np.diag(scale**2), (value[2], 0.001), fit,
        1e-6 * np.diag(scale**2),
    )  # fmt: skip
    return SimpleNamespace(estimates=estimates, trustworthy=True, single_samples=False)


def told(pwm=False, baseline=None, **values):
    return torques_of(identified(**values), baseline, VEHICLE, pwm, ABSENT)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({}, ()),
        ({"up": 0.026, "down": 0.027}, ()),
        ({"up": 0.065, "down": 0.075}, ("motor_lag",)),
        ({"up": 0.012, "down": 0.014}, ("motor_lag",)),
        ({"roll": 0.7, "pitch": 0.72, "yaw": 0.71}, ("inertia",)),
        ({"yaw": 0.5}, ("yaw_torque",)),
        ({"up": 0.06, "down": 0.06, "roll": 0.6, "pitch": 0.6, "yaw": 0.6}, ("motor_lag", "inertia")),
    ],
)  # fmt: skip
def test_what_acts_on_torques_is_named_and_nothing_beside(values, named):
    assert set(told(**values).names) == set(named)


def test_a_delay_beside_a_nominal_lag_may_be_a_late_command():
    torques = told(delay=0.03)
    assert torques.names == ("motor_lag",)
    assert "command_latency" in torques.equivalent["motor_lag"]
    mean, covariance = torques.parameters["motor_lag"]
    assert np.abs(mean - 0.03).max() < 2.0 * covariance[0, 0] ** 0.5 < 0.015


def test_what_a_weaker_thrust_does_to_gains_is_no_inertia():
    torques = told(roll=0.75, pitch=0.75, yaw=0.75)
    assert "inertia" in torques.names
    theta = ABSENT.copy()
    theta[PLACE["thrust_scale", "scale"]] = -0.25
    assert torques.with_thrust_of(theta, ("thrust_scale",)).names == ()


def test_gains_of_duty_cycles_tell_the_map_and_lags_the_motors():
    slow = told(pwm=True, up=0.07, down=0.07, roll=0.6, pitch=0.6, yaw=0.6)
    assert slow.names == ("motor_lag",)


def test_a_fit_whose_damping_is_no_rotors_says_less_of_inertia():
    assert "inertia" in told(roll=0.7, pitch=0.7, yaw=0.7).names
    assert "inertia" not in told(roll=0.7, pitch=0.7, yaw=0.7, damping=6.0).names


def test_poor_flights_hide_an_inertia_and_good_ones_do_not():
    assert told().untestable == frozenset()
    assert "inertia" in told(error=0.6).untestable
    assert set(told().probability) == set(TORQUES)


@pytest.mark.parametrize("lag", [0.0, 0.012])
def test_a_lag_shows_beside_the_reference_where_rows_hide_it(lag):
    """Both read 20 ms and gains that rows make wrong by a third."""

    def read(extra):
        found = identified(up=0.045 + extra, down=0.045 + extra, roll=0.7, pitch=0.7, yaw=0.7)
        found.estimates = replace(found.estimates, covariance=found.estimates.covariance + 0.3**2)
        found.single_samples, found.trustworthy = True, False
        return found

    baseline = SimpleNamespace(identification=read(0.0))
    torques = torques_of(read(lag), baseline, VEHICLE, False, ABSENT)
    assert torques.names == (("motor_lag",) if lag else ())
    start = np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    change = change_of(read(lag).estimates, read(0.0).estimates, start)
    assert change.of("motor_lag", "extra_up")[0] == pytest.approx(lag)
    assert torques_of(read(lag), None, VEHICLE, False, ABSENT) is None
