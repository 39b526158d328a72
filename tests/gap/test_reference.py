"""What a reference knows of a vehicle, against plain Gaussian algebra."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from openjax.commands.sample_flights import SampleFlightsCommand, make_case
from openjax.errors import UserError
from openjax.flights.flight import Case, Issue
from openjax.gap.channels import Estimated
from openjax.gap.decision import DECISION
from openjax.gap.folders import diagnose_folder
from openjax.gap.model.baseline import Baseline, day_of, transfer
from openjax.gap.model.library import ABSENT, PLACE
from openjax.gap.reference import differs, join, trim_of, trimmed_before, with_some
from openjax.gap.report.page import page_of
from openjax.gap.residual import HORIZONS, calibration, conformal_p
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.vehicle_file import load_vehicle_file


def baseline(channels=None):
    covariance = np.array([[4e-6, 3e-3], [3e-3, 9.0]])
    names = ("motor_lag extra_up", "delay of the motors")
    return Baseline(ABSENT, (), names, covariance, {}, channels or {}, np.zeros(4))


def test_mixed_columns_have_the_joint_distribution_that_the_reference_knows():
    known = baseline()
    names = ("frame tilt x", "motor_lag extra_up", "delay of the motors")
    mixing = known.mixing(names)
    expected = np.eye(3)
    expected[1:, 1:] = known.covariance
    # A column of weights z ~ N(0, 1) on mixed columns is one of x ~ N(0, C) on the
    # columns.
    np.testing.assert_allclose(mixing.T @ mixing, expected, rtol=1e-12)


def test_another_day_knows_what_was_shown_less_what_days_move():
    """By hand: normal numbers, of which the second is of its day alone, against
    conditioning the joint normal distribution of both days.
    """
    rng = np.random.default_rng(0)
    columns, measured = rng.normal(size=(20, 4)), rng.normal(size=20)
    columns[:, 3] = 0.0  # that flights don't show
    usual, days = np.array([1.0, 2.0, 0.5, 0.3]), np.array([0.5, 9.0, 0.1, 0.2])
    mean, covariance = transfer(
        columns.T @ columns,
        columns.T @ measured,
        np.diag(usual**-2.0),
        np.array([False, True, False, False]),
        days,
    )
    seen = np.array([0, 2, 3])
    there = usual**2  # the numbers on the day of the reference
    there[seen] += days[seen] ** 2
    across = columns[:, seen] * usual[seen] ** 2
    gain = np.linalg.solve(columns * there @ columns.T + np.eye(20), across).T
    np.testing.assert_allclose(mean, gain @ measured, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        covariance, np.diag(usual[seen] ** 2) - gain @ across, rtol=1e-9, atol=1e-12
    )
    assert covariance[2, 2] == pytest.approx(0.3**2)


def test_without_an_effect_the_numbers_of_the_others_stay_known():
    names = ("rotor_drag d_xy", "motor_lag extra_up")
    theta = ABSENT.copy()
    theta[[PLACE[tuple(n.split(" "))] for n in names]] = 0.004, 0.003
    known = Baseline(theta, ("rotor_drag",), names, np.diag([1e-6, 4e-6]), {}, {}, np.zeros(4))
    without = with_some(known, ())
    assert without.numbers == (("motor_lag", "extra_up", 1.0),) and not without.effects
    assert without.theta[PLACE["rotor_drag", "d_xy"]] == 0.0
    assert without.theta[PLACE["motor_lag", "extra_up"]] == 0.003
    np.testing.assert_array_equal(without.covariance, [[4e-6]])


def test_days_move_the_trims_and_an_unlogged_battery_moves_the_map_of_thrust():
    vehicle = load_vehicle()
    assert day_of("motor_imbalance", "m1", vehicle, silent=False) > 0.01
    loud, silent = (day_of("thrust_curve", "curvature", vehicle, silent=s) for s in (False, True))
    assert loud < 0.05 and silent > 0.1


def test_trims_that_the_reference_has_as_well_are_no_change():
    vehicle = load_vehicle()
    offset = ABSENT.copy()
    offset[[PLACE["com_offset", "x"], PLACE["com_offset", "y"]]] = 3e-4, -2e-4
    there = trim_of(offset, ("com_offset",), vehicle)
    # As what an offset is to rotors amid the vehicle: the torque of the same thrust.
    torque = np.asarray(vehicle.rotor_position)[:, :2].T @ there / 4.0
    np.testing.assert_allclose(torque, [-3e-4, 2e-4], rtol=1e-4)
    known = replace(baseline(), trim=1.2 * there)
    assert trimmed_before(offset, ("com_offset", "wind"), known, vehicle) == {"com_offset"}
    assert trimmed_before(offset, ("com_offset",), replace(known, trim=-there), vehicle) == set()
    assert trimmed_before(offset, ("com_offset",), None, vehicle) == set()


@pytest.mark.parametrize(
    ("before", "error", "acted", "changed"),
    [
        (0.0, 0.001, False, True),
        (0.019, 0.001, True, False),
        (0.04, 0.001, True, True),
        # flights that don't show it don't say that it was there
        (0.003, 0.05, False, True),
        (0.012, 0.05, False, False),
    ],
)
def test_a_delay_that_the_reference_has_as_well_is_no_change(before, error, acted, changed):
    def channel(value, error, acts):
        return SimpleNamespace(
            path="estimator",
            estimate=lambda effect, parameter: Estimated(value, error, error),
            acting=lambda: {"state_latency": 0.95} if acts else {},
        )

    known = baseline({"estimator": channel(before, error, acted)})
    assert differs(channel(0.02, 0.001, True), "state_latency", known) == changed


def test_the_same_growth_says_more_of_a_sensor_than_of_what_gusts_shake():
    usual = [pair["reference"] for pair in calibration("with_reference")]
    before = {n: float(np.median([c[n] for c in usual if n in c])) for n in HORIZONS}
    p_values = {
        name: conformal_p(before | {name: 1.6 * before[name]}, before)
        for name in ("accelerometer", "rates")
    }
    assert conformal_p(before, before)[0] > 0.5
    assert p_values["accelerometer"][1] == "accelerometer"
    assert p_values["accelerometer"][0] < DECISION.unknown < p_values["rates"][0]


def test_days_of_a_reference_are_joined_and_another_vehicle_is_refused():
    def day(name, mass):
        told = load_vehicle_file()
        vehicle = told.vehicle.replace(mass=jnp.asarray(mass))
        remark = Issue("flight_a.csv", f"of {name}")
        return Case(name, (), replace(told, vehicle=vehicle), (remark,))

    monday = day("monday", 0.03)
    assert len(join([monday, day("friday", 0.03)]).quality) == 2
    with pytest.raises(UserError, match=r"friday.*another mass"):
        join([monday, day("friday", 0.04)])


@pytest.mark.slow
def test_a_slower_motor_is_named_and_one_that_was_as_slow_before_is_no_change(tmp_path):
    def flown(name, seed, effects):
        arguments = SampleFlightsCommand(tmp_path / name, effect=effects or ("none",), seed=seed)
        make_case(arguments)
        return tmp_path / name

    slow = flown("slow", 2, ("motor_lag",))
    for name, seed, effects, expected in (
        ("healthy", 1, (), ("motor_lag",)),
        ("as slow", 3, ("motor_lag",), ()),
    ):
        days = [flown(f"{name} {day}", seed + 10 * day, effects) for day in (0, 1)]
        report = diagnose_folder(slow, days)
        assert report.effects == expected
        assert "reference" in report.reference
        assert report.trims.effects == expected
    assert "Trims beside the reference" in page_of(report)


@pytest.mark.slow
def test_wind_drags_by_the_drag_that_the_reference_has(tmp_path):
    """The vehicle had its drag before, in still air: it isn't dragged twice, nor by a
    stronger wind.
    """
    for name, effect in (("before", "rotor_drag"), ("since", "wind")):
        make_case(SampleFlightsCommand(tmp_path / name, effect=(effect,)))
    report = diagnose_folder(tmp_path / "since", [tmp_path / "before"])
    assert report.effects == ("wind",)
    for name in ("x", "y", "drag"):
        low, high = report.parameters["wind"][name].interval90
        assert low < EFFECTS["wind"].card.sample[name] < high
