"""What every effect's card must hold, and the bounded solution that all decisions rest
on.
"""

import dataclasses
from typing import get_args

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from openjax.gap.channels import Estimated
from openjax.gap.decision import DECISION
from openjax.gap.intervals import _estimate
from openjax.gap.model.bounds import solve_bounded
from openjax.gap.model.library import ABSENT, CARDS, STEP, THETA, places, prior
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import Need, Scale


@pytest.mark.parametrize("name", EFFECTS)
def test_a_card_is_complete(name):
    effect = EFFECTS[name]
    card = EFFECTS[name].card
    assert card.path in (
        "physics",
        "radio",
        "rate_loop",
        "estimator",
    ) and card.next_flight.endswith(".")
    assert {p.name for p in card.fitted} <= set(effect.parameters)
    assert all(p.spread > 0 and p.step > 0 for p in card.fitted)
    assert all(len(start) == len(card.fitted) for start in card.others)
    sizes = [size for p in card.fitted for size in dataclasses.astuple(p.nuisance)]
    assert all(size is None or callable(size) or size > 0 for size in sizes)
    assert set(card.needs) <= set(get_args(Need)) and set(card.scales) <= set(get_args(Scale))
    assert card.log_odds < 0
    assert all(p.practical is not None for p in card.fitted if p.coupling)


def test_what_couples_axes_is_known_apart_from_the_moments():
    """A body that is heavier all over has no product of inertia for that."""
    _, _, precision = prior(("inertia",))
    covariance = np.linalg.inv(precision)
    coupling = [p.coupling for p in CARDS["inertia"].fitted]
    assert sum(coupling) == 1
    np.testing.assert_allclose(covariance[coupling][:, ~np.array(coupling)], 0, atol=1e-9)


def test_every_fitted_parameter_has_its_own_place():
    physics = [e for e in CARDS if CARDS[e].path == "physics"]
    assert (
        sorted(places(physics)) == list(range(len(THETA)))
        and len(ABSENT) == len(STEP) == len(THETA) + 2
    )
    for effect in physics:
        index, mean, precision = prior((effect,))
        assert (
            len(index) == len(set(index)) == len(mean) and np.linalg.eigvalsh(precision).min() > 0
        )


def test_bounded_least_squares_agree_with_scipy():
    rng = np.random.default_rng(0)
    for size, free in ((6, 2), (30, 0), (30, 7)):
        root = np.concatenate(
            [rng.standard_normal((size, size)) * 10.0 ** rng.uniform(-2, 2, size), np.eye(size)]
        )
        target = root @ (5.0 * rng.standard_normal(size))
        limits = np.full(size, DECISION.nuisance_bound)
        limits[:free] = np.inf
        found = solve_bounded(root.T @ root, root.T @ target, free)
        best = lsq_linear(root, target, (-limits, limits), method="bvls", tol=1e-14)
        np.testing.assert_allclose(
            ((root @ found - target) ** 2).sum(), 2.0 * best.cost, rtol=1e-9, atol=1e-9
        )
        assert (np.abs(found[free:]) <= DECISION.nuisance_bound * (1 + 1e-6)).all()


def seems(effect, deviation=1e-6, **value):
    """Whether an effect fitted with these values is physically possible."""
    return CARDS[effect].possible(value, dict.fromkeys(value, deviation))


def test_what_pushes_along_the_motion_is_no_drag():
    assert seems("rotor_drag", d_xy=0.004, d_z=0.0) and not seems(
        "rotor_drag", d_xy=-0.01, d_z=0.004
    )
    assert seems("wind", x=0.5, y=0.0, z=0.0, drag=0.004, along=1.0)
    assert not seems("wind", x=0.5, y=0.0, z=0.0, drag=-0.004, along=1.0)
    assert not seems("wind", x=0.5, y=0.0, z=0.5, drag=0.004, along=-0.1)
    # a fan is nearly level, and a draught from below is weak
    assert seems("wind", x=9.2, y=-1.9, z=1.1, drag=0.018, along=1.0)
    assert not seems("wind", x=4.0, y=0.0, z=1.1, drag=0.018, along=1.0)


def test_what_no_air_and_no_rotor_does_is_something_else():
    # a thrust of duty cycles that isn't known
    assert not seems("wind", x=-0.35, y=0.0, z=2.0, drag=0.011, along=4.0)
    rotors = dict(m1=-0.01, m2=0.06, m3=0.02, m4=-0.07)
    assert seems("motor_imbalance", **rotors)
    # slow turns' thrust, where torques aren't judged
    assert not seems("motor_imbalance", **rotors | dict(m2=0.41, m3=-0.41))
    assert seems("ground_effect", strength=2.5, offset=0.016)
    # a third more thrust at 5 cm, rising to the floor as an exponential does
    assert seems("ground_effect", strength=3.8, offset=0.011)
    # a thrust that isn't known, in a vehicle that never was below .3 m
    assert not seems("ground_effect", strength=5.7, offset=-0.001)
    assert not seems("ceiling_effect", strength=1.9, offset=0.06)


def test_motors_may_brake_slowly_and_still_no_vehicle_flies_on_slow_ones():
    assert seems("motor_lag", extra_up=0.045, extra_down=0.157)
    assert not seems("motor_lag", extra_up=0.157, extra_down=0.157)
    assert not seems("motor_lag", extra_up=0.045, extra_down=0.5)


def test_how_blades_pitch_the_body_need_not_be_known():
    tilt = {"tilt": 0.03, "stiffness": -1e-5}
    assert seems("blade_flapping", 1e-4, **tilt)
    assert not seems("blade_flapping", 1e-6, **tilt)


def test_above_the_ceiling_there_is_none():
    low = np.zeros((5, 3))
    high = np.zeros((5, 3))
    high[2, 2] = 1.3
    assert CARDS["ceiling_effect"].impossible(high) and not CARDS["ceiling_effect"].impossible(low)


@pytest.mark.parametrize("spread", [0.1, 1.0, 100.0])
@pytest.mark.parametrize("name", EFFECTS)
def test_an_interval_ends_where_its_parameter_means_nothing(name, spread):
    """However wide the error of a fit, and wherever its value."""
    vehicle = load_vehicle()
    for parameter in EFFECTS[name].parameters.values():
        low, high = parameter.limits(vehicle)
        width = spread * (parameter.prior[1] - parameter.prior[0])
        for value in (parameter.none - width, parameter.none, parameter.none + width):
            found = _estimate(Estimated(value, width, width), parameter, vehicle)
            start, end = found.interval90
            assert low <= start <= found.value <= end <= high
            assert found.may_be_none
    assert not _estimate(
        Estimated(9.0, 0.1, 0.1), EFFECTS["inertia"].parameters["xx"], vehicle
    ).may_be_none
