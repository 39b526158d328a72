"""What a reference knows of a vehicle, against plain Gaussian algebra."""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.commands.sample_flights import Arguments, make_case
from openjax.flights.case import load_case
from openjax.gap.channels import Estimated
from openjax.gap.decision import DECISION
from openjax.gap.diagnosis import diagnose_case
from openjax.gap.model.baseline import Baseline, day_of
from openjax.gap.model.library import ABSENT
from openjax.gap.reference import differs
from openjax.gap.residual import changed_p
from openjax.vehicle import load_vehicle


def baseline(channels=None):
    covariance = np.array([[4e-6, 3e-3], [3e-3, 9.0]])
    names = ("motor_lag extra_up", "delay of the motors")
    return Baseline(ABSENT, names, covariance, {}, {}, channels or {})


def test_mixed_columns_have_the_joint_distribution_that_the_reference_knows():
    known = baseline()
    names = ("frame tilt x", "motor_lag extra_up", "delay of the motors")
    mixing = known.mixing(names)
    expected = np.eye(3)
    expected[1:, 1:] = known.covariance
    # A column of weights z ~ N(0, 1) on mixed columns is one of x ~ N(0, C) on the columns.
    np.testing.assert_allclose(mixing.T @ mixing, expected, rtol=1e-12)


def test_days_move_the_trims_and_an_unlogged_battery_moves_the_map_of_thrust():
    vehicle = load_vehicle()
    assert day_of("motor_imbalance", "m1", vehicle, silent=False) > 0.01
    loud, silent = (day_of("thrust_curve", "curvature", vehicle, silent=s) for s in (False, True))
    assert loud < 0.05 and silent > 0.1


@pytest.mark.parametrize(("before", "changed"), [(0.0, True), (0.019, False), (0.04, True)])
def test_a_delay_that_the_reference_has_as_well_is_no_change(before, changed):
    def channel(value):
        return SimpleNamespace(
            path="estimator", estimate=lambda effect, parameter: Estimated(value, 0.001, 0.001)
        )

    known = baseline({"estimator": channel(before)})
    assert differs(channel(0.02), "state_latency", known) == changed


def test_what_is_left_beyond_the_reference_is_judged_by_the_measure_that_grew_most():
    before = {"rates": 0.1, "velocity": 0.02}
    grown = {"rates": 0.1, "velocity": 0.02 * float(np.exp(DECISION.left_over))}
    assert changed_p(grown, before) == (pytest.approx(DECISION.unknown), "velocity")
    assert changed_p(before, before)[0] == 1.0
    assert changed_p({"position": 1.0}, before) == (1.0, "")


@pytest.mark.slow
def test_a_slower_motor_is_named_and_one_that_was_as_slow_before_is_no_change(tmp_path):
    def flown(name, seed, effects):
        arguments = Arguments(tmp_path / name, effect=effects or ("none",), seed=seed)
        make_case(arguments)
        return load_case(tmp_path / name)

    slow = flown("slow", 2, ("motor_lag",))
    for name, seed, effects, expected in (
        ("healthy", 1, (), ("motor_lag",)),
        ("as slow", 3, ("motor_lag",), ()),
    ):
        report = diagnose_case(slow, reference=[flown(name, seed, effects)])
        assert report.effects == expected
    assert "reference" in report.reference
