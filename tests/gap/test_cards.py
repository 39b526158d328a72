"""What every effect's card must hold, and the bounded solution that all decisions rest on."""

import numpy as np
import pytest
from scipy.optimize import minimize

from openjax.gap.model.bounds import BOUND, bounded
from openjax.gap.model.library import ABSENT, CARDS, STEP, THETA, places, prior, start_of
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
    sizes = (card.nuisance, card.nuisance_duty, card.nuisance_samples, card.form_error)
    assert all(set(s) <= set(effect.parameters) and all(v > 0 for v in s.values()) for s in sizes)
    assert card.log_odds < 0


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
        found, _ = bounded(hessian, push, 2)
        assert (np.abs(found[2:]) <= BOUND + 1e-12).all()
        cost = lambda x, h=hessian, p=push: 0.5 * x @ h @ x - p @ x  # noqa: E731
        best = minimize(cost, np.zeros(6), bounds=[(None, None)] * 2 + [(-BOUND, BOUND)] * 4).fun
        free = cost(np.linalg.solve(hessian, push))
        assert (
            cost(found) - best <= 0.15 * (best - free) + 1e-6
        )  # fixing what leaves the box comes close to the best


def seems(effect, deviation=1e-6, **value):
    """Whether an effect fitted with these values is physically possible."""
    return CARDS[effect].possible(value, dict.fromkeys(value, deviation))


def test_what_pushes_along_the_motion_is_no_drag():
    assert seems("rotor_drag", d_xy=0.004, d_z=0.0) and not seems("rotor_drag", d_xy=-0.01, d_z=0.004)
    assert seems("wind", x=0.5, y=0.0, z=0.0, drag=0.004, along=1.0)
    assert not seems("wind", x=0.5, y=0.0, z=0.0, drag=-0.004, along=1.0)
    assert not seems("wind", x=0.5, y=0.0, z=1.0, drag=0.004, along=-0.1)


def test_above_the_ceiling_there_is_none():
    low, high = np.zeros((5, 3)), np.zeros((5, 3))
    high[2, 2] = 1.3
    assert CARDS["ceiling_effect"].impossible(high) and not CARDS["ceiling_effect"].impossible(low)
