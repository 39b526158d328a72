"""What every effect's card must hold, and the bounded solution that all decisions rest on."""

import numpy as np
import pytest
from scipy.optimize import minimize

from openjax.gap.bounds import bounded
from openjax.gap.library import ABSENT, CARDS, STEP, THETA, places, prior, start_of
from openjax.vehicle.effects import EFFECTS


@pytest.mark.parametrize("name", EFFECTS)
def test_a_card_is_complete(name):
    effect, card = EFFECTS[name], EFFECTS[name].card
    assert card.path in ("physics", "radio", "rate_loop", "estimator") and card.next_flight.endswith(".")
    assert {p.name for p in card.fitted} <= set(effect.parameters) and set(card.sample) <= set(
        effect.parameters
    )
    assert all(p.spread > 0 and p.step > 0 for p in card.fitted)
    assert all(len(start) == len(card.fitted) for start in card.others)
    assert all(parameter in EFFECTS[other].parameters for other, parameter, _ in card.companions)
    assert set(card.commoner) <= set(CARDS)


def test_every_fitted_parameter_has_its_own_place():
    physics = [e for e in CARDS if CARDS[e].path == "physics"]
    assert sorted(places(physics)) == list(range(len(THETA))) and len(ABSENT) == len(STEP) == len(THETA) + 1
    for effect in physics:
        index, mean, precision = prior((effect,))
        assert len(index) == len(set(index)) == len(mean) and np.linalg.eigvalsh(precision).min() > 0
        assert len(start_of(effect)) == len(CARDS[effect].fitted)


def test_nuisances_stay_within_their_bounds():
    rng = np.random.default_rng(0)
    for _ in range(5):
        root = rng.standard_normal((6, 6))
        hessian, push = root @ root.T + np.eye(6), 20.0 * rng.standard_normal(6)
        found, _ = bounded(hessian, push, 2, 1.5)
        assert (np.abs(found[2:]) <= 1.5 + 1e-12).all()
        cost = lambda x, h=hessian, p=push: 0.5 * x @ h @ x - p @ x  # noqa: E731
        best = minimize(cost, np.zeros(6), bounds=[(None, None)] * 2 + [(-1.5, 1.5)] * 4).fun
        free = cost(np.linalg.solve(hessian, push))
        assert (
            cost(found) - best <= 0.15 * (best - free) + 1e-6
        )  # fixing what leaves the box comes close to the best


def seems(effect, deviation=1e-6, **value):
    """Whether an effect fitted with these values is itself."""
    return CARDS[effect].is_itself(value, dict.fromkeys(value, deviation))


def test_a_heavy_body_that_turns_before_its_motors_act_is_a_gust():
    heavy = {"xx": 1.3, "yy": 1.3, "zz": 1.2}
    late, early = ({f"motor_lag.{k}": v for k in ("extra_up", "extra_down")} for v in (0.001, -0.008))
    gusty, calm = {"gusts": 0.2}, {"gusts": 0.05}
    assert seems("inertia", **heavy, **late, **gusty) and not seems("inertia", **heavy, **early, **gusty)
    assert seems("inertia", deviation=0.01, **heavy, **early, **gusty)  # so unsure a lag says nothing
    assert seems("inertia", xx=0.8, yy=0.8, zz=0.9, **early, **gusty)
    assert seems("inertia", **heavy, **early, **calm)  # more than these gusts can feign
    assert not seems("inertia", xx=0.97, yy=0.97, zz=1.0, **late, **calm)
    assert seems("motor_lag", extra_up=0.01, extra_down=0.02)
    assert not seems("motor_lag", extra_up=-0.008, extra_down=-0.007)
    assert not seems("motor_lag", extra_up=0.5, extra_down=0.4)


def test_what_pushes_along_the_motion_is_no_drag():
    assert seems("rotor_drag", d_xy=0.004, d_z=0.0) and not seems("rotor_drag", d_xy=-0.01, d_z=0.004)
    assert seems("wind", x=0.5, y=0.0, z=0.0, drag=0.004, along=1.0)
    assert not seems("wind", x=0.5, y=0.0, z=0.0, drag=-0.004, along=1.0)


def test_what_pitches_the_body_like_drag_is_drag():
    # Drag 0.5 cm above the centre of mass of a 30 g vehicle whose thrust tilts 0.01 rad per m/s, and flapping 3 cm above.
    weight, tilt = 0.03 * 9.81, 0.01
    assert not seems("blade_flapping", tilt=tilt, stiffness=0.005 * weight * tilt)
    assert seems("blade_flapping", tilt=tilt, stiffness=0.03 * weight * tilt)
    assert not seems("blade_flapping", tilt=-tilt, stiffness=0.03 * weight * tilt)


def test_a_curve_that_hardly_bends_is_a_scale():
    assert not seems("thrust_curve", offset=0.0, slope=0.95, curvature=0.005)
    assert seems("thrust_curve", offset=0.0, slope=0.9, curvature=0.15)
    assert not seems("thrust_curve", offset=0.5, slope=0.2, curvature=0.0)  # hardly the motors' doing


def test_above_the_ceiling_there_is_none():
    low, high = np.zeros((5, 3)), np.zeros((5, 3))
    high[2, 2] = 1.3
    assert CARDS["ceiling_effect"].impossible(high) and not CARDS["ceiling_effect"].impossible(low)
