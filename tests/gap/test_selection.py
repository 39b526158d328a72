"""The criterion against closed forms: differences of log density, shares that add up,
probabilities of form errors.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap import selection
from openjax.gap.channels import of_flights
from openjax.gap.criteria import clearly_larger, departs, difference, practical, worse
from openjax.gap.model import hypotheses
from openjax.gap.model.cross_validation import Validation
from openjax.gap.model.library import ABSENT, PLACE, places
from openjax.gap.selection import Hypothesis
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects.thrust_curve import bend


def judged(left: np.ndarray, blocks: int) -> Validation:
    """A hypothesis that leaves whitened residuals `left` in equal blocks."""
    starts = np.arange(0, len(left), len(left) // blocks)
    nats = -0.5 * np.add.reduceat(left**2, starts)
    none = np.zeros((2, 1))
    return Validation(nats, np.ones((blocks, 6)), none, left, starts)


def test_the_difference_of_two_hypotheses_has_the_error_that_repeated_noise_shows():
    rng = np.random.default_rng(0)
    effect = np.zeros(1000)
    effect[300:350] = 0.8  # acts in one block of twenty
    found = np.array([
        difference(judged(noise, 20), judged(noise + effect, 20)) for noise in rng.standard_normal((400, 1000))
    ])  # fmt: skip
    assert found[:, 0].mean() == pytest.approx(0.5 * (effect**2).sum(), rel=0.1)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.25)
    # A gain in one block alone is told: it is five standard errors there, though the
    # rest of the flight says nothing.
    assert np.median(found[:, 0] / found[:, 1]) > 2.0


def test_the_difference_counts_blocks_not_samples_where_the_residual_is_coloured():
    rng = np.random.default_rng(1)
    slow = np.repeat(
        rng.standard_normal((300, 20)), 50, axis=1
    )  # every block has one draw of noise
    effect = np.full(1000, 0.3)
    found = np.array([difference(judged(n, 20), judged(n + effect, 20)) for n in slow])
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.2)
    assert found[:, 1].mean() > 3.0 * np.sqrt((effect**2).sum())


def test_one_hypothesis_is_as_good_as_itself():
    one = judged(np.random.default_rng(2).standard_normal(100), 5)
    gain, error, _ = difference(one, one)
    assert gain == 0.0 and error < 1e-3


def test_a_set_is_worse_if_that_is_clear_and_leaves_a_gap_that_matters():
    """However large the gap of no effect is: a wind is one beside rotors that differ by thirty
    floors, too.
    """
    best = np.array([100.0, 100.0])
    larger = best * 1.1
    assert worse(10.0, 4.0, larger, best)
    assert not worse(10.0, 6.0, larger, best)  # within two standard errors
    assert not worse(10.0, 4.0, best * 1.05, best)  # 2.5 % of a floor
    both = worse(np.array([10.0, 0.0]), 4.0, np.array([larger, best]), best)
    assert both.tolist() == [True, False]


def test_a_set_that_leaves_its_bounds_once_settled_is_not_chosen(monkeypatch):
    sets = {frozenset({"mass"}): 0.7, frozenset({"wind"}): 0.2, frozenset(): 0.1}
    search = SimpleNamespace(
        hypotheses={
            key: Hypothesis(SimpleNamespace(effects=tuple(key), replay=None, theta=0.0), None, 0.0)
            for key in sets
        },
        weights=lambda: {
            key: sets[key] for key, h in search.hypotheses.items() if possible(h.fit)
        },
    )  # fmt: skip

    def possible(fit):
        return not (fit.theta == 10.0 and fit.effects == ("mass",))

    def settled(replay, effects, theta, rounds):
        return SimpleNamespace(effects=effects, replay=replay, theta=float(rounds))

    monkeypatch.setattr(selection, "possible", possible)
    monkeypatch.setattr(selection, "fit_set", settled)
    weights, best, fit = selection.settle(search)
    assert best.effects == fit.effects == ("wind",)
    assert frozenset({"mass"}) not in weights


def test_what_only_a_sum_is_known_of_is_clear_by_the_sum():
    least = np.full(2, 0.5)
    apart = np.eye(2)
    # the sum is known to .1, the difference to 3
    together = 0.5 * (0.005 * np.ones((2, 2)) + 4.5 * np.array([[1, -1], [-1, 1]]))
    assert not clearly_larger(np.array([1.0, 1.0]), apart, least)
    assert clearly_larger(np.array([1.0, 1.0]), together, least)
    assert not clearly_larger(np.array([1.0, -1.0]), together, least)
    assert clearly_larger(np.array([2.5, 0.0]), apart, least)


def test_intervals_hold_a_mean_that_three_flights_differ_by():
    """Flights as loud as usual: `dispersion` variances of what their rows say."""
    rng = np.random.default_rng(4)
    covariance = np.eye(1) / 3.0
    flights = np.sqrt(2.6) * rng.standard_normal((4000, 3))
    reach = (
        1.645
        * np.array([of_flights(covariance, (f - f.mean())[:, None])[0, 0] for f in flights]) ** 0.5
    )
    assert 0.87 < (np.abs(flights.mean(1)) < reach).mean() < 0.95
    # and three that agree by chance aren't believed to
    alike = of_flights(covariance, np.zeros((3, 1)))[0, 0]
    assert alike > covariance[0, 0]


def test_what_a_scale_does_as_well_is_no_curve():
    known = 1e-8 * np.eye(3)
    assert not departs(np.array([0.0, 0.1, 0.0]), known, bend())
    # 2 % of slope, taken back by the offset where vehicles hover
    assert not departs(np.array([0.013, -0.02, 0.0]), known, bend())
    assert departs(np.array([0.0, -0.1, 0.12]), known, bend())


def of_one_effect(effect, values, covariance):
    theta = ABSENT.copy()
    index = places((effect,))
    theta[index] = values
    return SimpleNamespace(
        effects=(effect,),
        theta=theta,
        index=index,
        hessian=np.linalg.inv(covariance),
        grams=np.zeros((1, 1 + len(index), 1)),
        replay=SimpleNamespace(absent=ABSENT, size_factors=np.ones(len(ABSENT)), other_sizes={}),
    )


def test_a_plane_whose_place_is_not_known_acts_if_its_push_is():
    """Strength and offset of a ground effect trade places along a line."""
    along = np.array([0.4, 0.01])
    covariance = np.outer(along, along) + np.diag([1e-4, 1e-8])
    fit = of_one_effect("ground_effect", (0.5, 0.012), covariance)
    assert practical(fit)
    weak = of_one_effect("ground_effect", (0.05, 0.012), covariance)
    assert not practical(weak)


def test_a_set_is_fitted_only_if_each_of_its_effects_adds_something():
    """Beside a wind a mass adds nothing, and a drag that alone says nothing does."""
    promises = {"": 0.0, "m": 5.0, "w": 20.0, "d": -2.0, "mw": 19.0, "dw": 25.0, "dmw": 24.5}
    base = frozenset({"lag"})
    score = {base.union(key): nats for key, nats in promises.items()}
    assert selection.worth_fitting(score, base) == [base.union(key) for key in ("dw", "w", "m")]


@pytest.mark.parametrize(("alone", "begins"), [(-14.0, 0.4), (0.6, 0.6)])
def test_an_effect_that_alone_is_forbidden_begins_at_its_start(monkeypatch, alone, begins):
    """Where rotors differ a floor alone takes what it can of that, and pulls: beside them
    it is searched from its start.
    """

    def at(replay, effects, theta):
        return SimpleNamespace(theta=theta)

    def descend(fit, iterations):
        theta = fit.theta.copy()
        theta[PLACE["ground_effect", "strength"]] = alone
        return SimpleNamespace(theta=theta)

    start = ABSENT.copy()
    start[places(("ground_effect",))] = 0.4, 0.012
    monkeypatch.setattr(hypotheses, "_at", at)
    monkeypatch.setattr(hypotheses, "_descend", descend)
    monkeypatch.setattr(hypotheses, "_best_start", lambda *_: start)
    physics = SimpleNamespace(vehicles=(load_vehicle(),))
    replay = SimpleNamespace(other_sizes={}, physics=physics, alone=lambda _, theta: theta)
    single = hypotheses.fit_single(replay, "ground_effect")
    assert single.theta[PLACE["ground_effect", "strength"]] == begins
