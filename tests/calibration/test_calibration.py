"""Calibration: a vehicle with other constants, flown and logged, is recovered within
the intervals; what flights can't tell is said and kept nominal.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from openjax.calibration.calibration import calibrate
from openjax.commands.calibrate import main
from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.checks import check_flight
from openjax.flights.flight import Case
from openjax.flights.manoeuvres import references
from openjax.flights.reading import flights_of
from openjax.flights.samples import fly, log_of
from openjax.vehicle import load_vehicle
from openjax.vehicle.vehicle_file import VehicleFile, load_vehicle_file
from openjax.vehicle.vehicle_tables import Motor

NOMINAL = load_vehicle()
# Relative to nominal: thrust, inertia xx, yy, torque per thrust's share, motor time
# constant.
ALTERED = {
    "thrust_constant": 1.09,
    "xx": 1.2,
    "yy": 0.85,
    "torque_constant": 0.4,
    "motor_time_constant": 1.8,
}


def altered(thrust_constant, xx, yy, torque_constant, motor_time_constant):
    return NOMINAL.replace(
        thrust_constant=NOMINAL.thrust_constant * thrust_constant,
        torque_constant=NOMINAL.torque_constant * torque_constant,
        motor_time_constant=NOMINAL.motor_time_constant * motor_time_constant,
        inertia=NOMINAL.inertia * jnp.array([xx, yy, 1.0]),
    )


def columns_of(plant, effects=None, names=("flight_a", "flight_b", "flight_c")):
    """What is logged of the named sample flights of a plant."""
    return {
        name: fly(plant, NOMINAL, reference, 10 + number, effects)[0]
        for number, (name, reference) in enumerate(references(seed=1, duration=5.0).items())
        if name in names
    }


def case_of(logged, change=lambda columns: columns, weighed=True, **file):
    """A case of flights; `change` says what of their columns was logged."""
    flights = []
    for name, columns in logged.items():
        (flight,), _ = flights_of(log_of([change(columns)], name))
        checked, issues = check_flight(flight, NOMINAL)
        assert not any(i.refused for i in issues), issues
        flights.append(checked)
    return Case("case", tuple(flights), VehicleFile(vehicle=NOMINAL, mass_weighed=weighed, **file))


@pytest.fixture(scope="module")
def altered_columns():
    return columns_of(altered(**ALTERED))


@pytest.fixture(scope="module")
def altered_case(altered_columns):
    return case_of(altered_columns)


@pytest.fixture(scope="module")
def nominal_columns():
    return columns_of(NOMINAL)


def truths(scale):
    inertia = np.asarray(NOMINAL.inertia)
    return [
        ("thrust_constant", 0, float(NOMINAL.thrust_constant) * scale["thrust_constant"]),
        ("torque_constant", 0, float(NOMINAL.torque_constant) * scale["torque_constant"]),
        (
            "motor_time_constant",
            0,
            float(NOMINAL.motor_time_constant) * scale["motor_time_constant"],
        ),
        ("inertia", 0, inertia[0] * scale["xx"]),
        ("inertia", 1, inertia[1] * scale["yy"]),
    ]


def assert_recovered(result, scale, tolerance, but=()):
    for name, axis, truth in truths(scale):
        if name not in but:
            quantity = result.quantities[name]
            low, high = quantity.interval90[axis]
            # Of some thirty 90 % intervals here three may miss: half as wide again must
            # hold them all.
            half_width = 0.5 * np.log(high / low)
            assert (
                quantity.determined and abs(np.log(quantity.value[axis] / truth)) < 1.5 * half_width
            ), (name, axis)
            assert quantity.value[axis] == pytest.approx(truth, rel=tolerance)


def test_an_altered_vehicle_is_recovered(altered_case):
    result = calibrate(altered_case)
    assert_recovered(result, ALTERED, 0.06)
    assert result.explained["body rates"][1] > 0.99 > result.explained["body rates"][0]
    (only,) = result.cannot_tell
    assert only.startswith("yaw torque constant against yaw inertia")


def test_the_nominal_vehicle_stays_nominal(nominal_columns):
    same = dict.fromkeys(ALTERED, 1.0)
    assert_recovered(calibrate(case_of(nominal_columns)), same, 0.05)


def test_drag_and_an_offset_centre_of_mass_are_not_taken_for_the_constants():
    effects = {"rotor_drag": {"d_xy": 0.02, "d_z": 0.01}, "com_offset": {"x": 0.002, "y": -0.001}}
    result = calibrate(case_of(columns_of(NOMINAL, effects)))
    assert_recovered(result, dict.fromkeys(ALTERED, 1.0), 0.06, but=("motor_time_constant",))
    assert result.nuisances["rotor_drag d_xy"][0] == pytest.approx(0.02, rel=0.1)


def test_without_weighing_the_assumed_mass_carries_over(altered_case):
    file = dataclasses.replace(altered_case.vehicle_file, mass_weighed=False)
    heavier = dataclasses.replace(file, vehicle=NOMINAL.replace(mass=NOMINAL.mass * 1.1))
    weighed, assumed = (
        calibrate(dataclasses.replace(altered_case, vehicle_file=f)) for f in (file, heavier)
    )
    for name in ("thrust_constant", "inertia"):
        ratio = assumed.quantities[name].value[0] / weighed.quantities[name].value[0]
        assert ratio == pytest.approx(1.1, rel=0.01)
        assert "wasn't weighed" in weighed.quantities[name].notes
    assert any("mass against thrust" in text for text in assumed.cannot_tell)


def test_gyroscope_and_accelerometer_alone_are_enough(altered_columns):
    def imu_only(columns):
        return {
            n: v
            for n, v in columns.items()
            if n not in ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
        }

    # The accelerometer's own offset (up to 0.3 m/s^2) then limits what is known of
    # thrust: 3 %.
    assert_recovered(calibrate(case_of(altered_columns, imu_only)), ALTERED, 0.1)


def test_with_duty_cycles_the_thrust_map_is_a_nuisance():
    def duty_cycles(columns):
        voltage = np.interp(columns["t"], columns["t"][::10], columns["vbat"][::10])
        # g
        full = 4 * float(NOMINAL.thrust_constant * NOMINAL.max_rotor_speed**2) / 9.81e-3
        motors = {}
        for name in ("m1", "m2", "m3", "m4"):
            grams = (
                0.8 * full * columns[name]
            )  # the vehicle gives 1 / 0.8 of what the public map says
            motors[name] = (-0.0006239 * grams**2 + 0.088 * grams) / voltage
        return columns | motors

    scale = ALTERED | {"thrust_constant": 1.0}
    logged = columns_of(altered(**scale))
    result = calibrate(case_of(logged, duty_cycles, motor=Motor(command="pwm")))
    assert "thrust_constant" not in result.calibrated()
    assert any(
        "Against the public map the flights' thrust per assumed mass is 1.2" in t
        for t in result.cannot_tell
    )
    assert_recovered(result, scale, 0.1, but=("thrust_constant",))


def test_what_is_not_excited_is_left_nominal(nominal_columns):
    """The motors' common part alone, so that no torque acts."""
    case = case_of({name: nominal_columns[name] for name in ("flight_a", "flight_b")})
    common = tuple(
        dataclasses.replace(
            f, motor_command=np.repeat(f.motor_command.mean(1, keepdims=True), 4, 1)
        )
        for f in case.flights
    )
    result = calibrate(dataclasses.replace(case, flights=common))
    assert (
        not result.quantities["inertia"].determined
        and not result.quantities["torque_constant"].determined
    )
    assert "thrust_constant" in result.calibrated()


def test_flights_without_motor_commands_cannot_calibrate(nominal_columns):
    def no_motors(columns):
        return {n: v for n, v in columns.items() if n not in ("m1", "m2", "m3", "m4")}

    with pytest.raises(UserError, match="motor commands"):
        calibrate(case_of(nominal_columns, no_motors))


def test_the_command_writes_a_file_that_loads(case_folder, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    main([str(case_folder), "--out", str(out)])
    printed = capsys.readouterr().out
    assert "What these flights can't tell" in printed and "thrust constant" in printed
    file = load_vehicle_file(out)
    assert set(file.calibrated) == {
        "thrust_constant",
        "torque_constant",
        "motor_time_constant",
        "inertia",
    }
    np.testing.assert_allclose(file.vehicle.thrust_constant, NOMINAL.thrust_constant, rtol=0.02)
    with pytest.raises(UserError, match="--overwrite"):
        main([str(case_folder), "--out", str(out)])
    (case_folder / "vehicle.toml").write_text(out.read_text())
    again = load_case(case_folder)  # the diagnosis starts from the calibrated vehicle
    np.testing.assert_array_equal(again.vehicle_file.vehicle.inertia, file.vehicle.inertia)


@pytest.mark.parametrize("problem", ["no folder", "unknown key", "no logs"])
def test_bad_input_is_one_line_and_leaves_nothing(case_folder, tmp_path, problem):
    out = tmp_path / "out.toml"
    case = case_folder
    if problem == "no folder":
        case = tmp_path / "nowhere"
    elif problem == "unknown key":
        (case / "vehicle.toml").write_text("[vehicle]\nweight = 3")
    else:
        for log in case.glob("*.gz"):
            log.write_text("t,wx\n")
    with pytest.raises(UserError) as caught:
        main([str(case), "--out", str(out)])
    assert "\n" not in str(caught.value)
    assert not out.exists() and not list(tmp_path.glob("*.partial"))
