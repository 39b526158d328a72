"""vehicle.toml: strict where a slip would go unnoticed, free for facts, unchanged by a
round trip.
"""

import dataclasses

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.vehicle import load_vehicle
from openjax.vehicle.parameters import assets_directory
from openjax.vehicle.vehicle_file import (
    VehicleFile,
    copy_vehicle_file,
    load_vehicle_file,
    save_vehicle_file,
)
from openjax.vehicle.vehicle_numbers import CalibratedValue
from openjax.vehicle.vehicle_tables import Motor

FULL = """
[vehicle]
name = "cf-07"
mass = 0.0335            # kg, with markers
mass_weighed = true

[vehicles.2]
mass = 0.0318

[motor]
command = "pwm"
order = ["rear_left", "front_left", "front_right", "rear_right"]
spin = ["ccw", "cw", "ccw", "cw"]
torque_per_thrust = 0.006

[log]
source = "ours"
floor_z = 0.05
anything = [1, 2]

[[log.flight]]
file = "a.csv"

[calibrated.thrust_constant]
value = 2.2e-8
interval90 = [2.1e-8, 2.3e-8]
unit = "N s^2"

[calibrated.inertia]
value = [1.5e-5, 1.5e-5, 2.5e-5]
interval90 = [[1.4e-5, 1.6e-5], [1.4e-5, 1.6e-5], [2.3e-5, 2.7e-5]]
"""


def write(tmp_path, text):
    path = tmp_path / "vehicle.toml"
    path.write_text(text)
    return path


def test_what_the_file_says_is_applied(tmp_path):
    file = load_vehicle_file(write(tmp_path, FULL))
    assert (file.name, file.mass_weighed, file.motor.command) == ("cf-07", True, "pwm")
    # the nominal m1, front right, is logged as m3
    assert file.motor_permutation == (2, 3, 0, 1)
    vehicle = file.vehicle
    assert float(vehicle.mass) == pytest.approx(0.0335)
    assert float(vehicle.thrust_constant) == pytest.approx(2.2e-8)
    assert float(vehicle.torque_constant) == pytest.approx(0.006 * 2.2e-8)
    np.testing.assert_allclose(vehicle.inertia, [1.5e-5, 1.5e-5, 2.5e-5], rtol=1e-6)
    assert float(file.vehicle_of("2").mass) == pytest.approx(0.0318)
    assert float(file.vehicle_of("1").mass) == pytest.approx(0.0335)
    assert file.log["floor_z"] == 0.05 and file.log["anything"] == [1, 2]


def test_an_empty_file_is_the_nominal_vehicle(tmp_path):
    nominal = load_vehicle()
    file = load_vehicle_file(write(tmp_path, ""))
    for name in ("mass", "inertia", "thrust_constant", "torque_constant", "rotor_spin"):
        np.testing.assert_array_equal(getattr(file.vehicle, name), getattr(nominal, name))
    assert file.motor_permutation == (0, 1, 2, 3)


def test_spin_follows_the_place_and_can_be_reversed(tmp_path):
    nominal = load_vehicle()
    moved = load_vehicle_file(
        write(
            tmp_path, '[motor]\norder = ["rear_right", "front_right", "front_left", "rear_left"]\n'
        )
    )
    np.testing.assert_array_equal(moved.vehicle.rotor_spin, nominal.rotor_spin)
    assert moved.motor.spin == ("cw", "ccw", "cw", "ccw")
    reversed_ = load_vehicle_file(write(tmp_path, '[motor]\nspin = ["cw", "ccw", "cw", "ccw"]\n'))
    np.testing.assert_array_equal(reversed_.vehicle.rotor_spin, -nominal.rotor_spin)


def test_saving_keeps_text_and_comments_and_replaces_the_calibration(tmp_path):
    file = load_vehicle_file(write(tmp_path, FULL))
    value = CalibratedValue((0.031,), ((0.028, 0.034),), "from up and down steps")
    changed = dataclasses.replace(file, calibrated={"motor_time_constant": value})
    save_vehicle_file(tmp_path / "new.toml", changed)
    text = (tmp_path / "new.toml").read_text()
    assert "# kg, with markers" in text and "thrust_constant" not in text
    again = load_vehicle_file(tmp_path / "new.toml")
    assert float(again.vehicle.motor_time_constant) == pytest.approx(0.031)
    assert again.calibrated["motor_time_constant"] == value
    assert again.log["anything"] == [1, 2]
    assert list(tmp_path.glob(".writing-*")) == []


def test_a_file_made_from_nothing_reads_back(tmp_path):
    file = VehicleFile(
        vehicle=load_vehicle(), name="new", motor=Motor(command="pwm"), mass_weighed=True
    )
    save_vehicle_file(tmp_path / "vehicle.toml", file)
    again = load_vehicle_file(tmp_path)
    assert (again.name, again.motor.command, again.mass_weighed) == ("new", "pwm", True)
    np.testing.assert_allclose(again.vehicle.mass, file.vehicle.mass, rtol=1e-5)


def test_a_name_or_a_file_says_the_airframe(tmp_path):
    mass = float(load_vehicle("brushless").mass)
    assert float(load_vehicle_file("brushless").vehicle.mass) == mass
    path = write(tmp_path, '[vehicle]\nairframe = "brushless"\n')
    file = load_vehicle_file(path)
    assert (file.airframe, file.name) == ("brushless", "brushless") and float(
        file.vehicle.mass
    ) == mass
    save_vehicle_file(tmp_path / "again.toml", dataclasses.replace(file, path=None))
    assert float(load_vehicle_file(tmp_path / "again.toml").vehicle.mass) == mass


def test_an_mjcf_of_ones_own_goes_where_its_vehicle_file_goes(tmp_path):
    xml = (assets_directory() / "crazyflie.xml").read_text()
    (tmp_path / "heavy.xml").write_text(xml.replace('mass="0.0321"', 'mass="0.0402"'))
    file = load_vehicle_file(path := write(tmp_path, '[vehicle]\nairframe = "heavy.xml"\n'))
    copy_vehicle_file(path, tmp_path / "run" / "vehicle.toml")
    save_vehicle_file(tmp_path / "case" / "vehicle.toml", dataclasses.replace(file, path=None))
    for folder in ("run", "case"):
        assert float(load_vehicle_file(tmp_path / folder).vehicle.mass) == pytest.approx(0.0402)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[vehicle]\nairframe = 'none.xml'", "it must be crazyflie, brushless, or"),
        ("[vehicle]\nairframe = '../none.xml'", "name of an MJCF file beside it"),
        ("[vehicle]\nairframe = ''", "it must be crazyflie, brushless, or"),
        ("[vehicle]\nairframe = ['brushless']", "expected text"),
        ("[vehicle]\nmas = 0.03", "vehicle has the unknown key 'mas'; did you mean mass"),
        ("[vehicles.1]\ninertia = 1", "unknown key 'inertia'"),
        ("[motors]\ncommand = 'pwm'", "unknown key 'motors'; did you mean motor"),
        ("[motor]\ncommand = 'rpm'", "motor.command is 'rpm'; expected one of"),
        (
            "[motor]\norder = ['front_right', 'front_right', 'rear_left', 'front_left']",
            "motor.order",
        ),
        ("[motor]\nspin = ['cw', 'cw', 'cw', 'ccw']", "motor.spin"),
        ("[vehicle]\ninertia = [1e-5, 1e-5, 3e-5]", "none of the three is larger than the sum"),
        ("[log]\nfloor_z = 1.0\nceiling_z = 0.9", "must be above floor_z, 1 m"),
        ("[log]\nmotor_rows = 'average'", "log.motor_rows is 'average'; expected one of"),
        ("[vehicle]\nmass = 32.1", "it must be in .0.005, 10. kg"),
        ("[vehicle]\nmass = -1", "it must be in"),
        ("[vehicle]\nmass = nan", "finite number"),
        ("[vehicle]\nmass_weighed = 'yes'", "expected true or false"),
        ("[calibrated.drag]\nvalue = 1", "calibrated: a key is 'drag'; expected one of 'mass'"),
        ("[calibrated.mass]\nvalue = 0.03", "calibrated.mass lacks interval90"),
        ("[calibrated.mass]\nvalue = 30\ninterval90 = [29, 31]\nunit = 'g'", "must be in 'kg'"),
        ("[calibrated.inertia]\nvalue = 1e-5\ninterval90 = [1e-5, 2e-5]", "3 numbers"),
        ("[calibrated.mass]\nvalue = 1e-9\ninterval90 = [0, 1]", "far from the nominal"),
        ("[log]\nx = " + "[" * 500 + "]" * 500, "nested more than"),
        ("[log]\nx = 1" + "0" * 40, "more than 64 bits"),
        ("[vehicle", "not readable as TOML"),
    ],
)
def test_a_slip_is_one_clear_line(tmp_path, text, reason):
    path = write(tmp_path, text)
    with pytest.raises(UserError, match=reason) as caught:
        load_vehicle_file(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_heavy_vehicle_by_its_mass_and_inertia_has_the_airframes_shape(tmp_path):
    """1.5 kg, moments of inertia as of a frame with arms of a quarter of a metre."""
    path = tmp_path / "vehicle.toml"
    path.write_text("[vehicle]\nmass = 1.5\n")
    with pytest.raises(UserError, match=r"above 1 kg give vehicle\.inertia .*MJCF"):
        load_vehicle_file(path)
    path.write_text("[vehicle]\nmass = 11.0\ninertia = [0.1, 0.1, 0.2]\n")
    with pytest.raises(UserError, match=r"\[0\.005, 10\] kg"):
        load_vehicle_file(path)
    small = load_vehicle_file().vehicle
    heavier = 1.5 / float(small.mass)
    longer = 7.0
    inertia = (np.asarray(small.inertia) * heavier * longer**2).tolist()
    path.write_text(f"[vehicle]\nmass = 1.5\ninertia = {inertia}\n")
    vehicle = load_vehicle_file(path).vehicle
    np.testing.assert_allclose(vehicle.inertia, inertia, rtol=1e-6)
    np.testing.assert_allclose(vehicle.rotor_position, longer * small.rotor_position, rtol=1e-5)
    # hover at the same share of the largest thrust, roll torque per inertia as geometry
    # says
    weight = [float(v.mass / v.thrust_constant) for v in (small, vehicle)]
    assert weight[1] == pytest.approx(weight[0], rel=1e-5)


def test_a_crazyflies_inertia_leaves_its_rotors_alone(tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text("[vehicle]\nmass = 0.04\ninertia = [2e-5, 2e-5, 3e-5]\n")
    small = load_vehicle_file().vehicle
    vehicle = load_vehicle_file(path).vehicle
    np.testing.assert_allclose(vehicle.inertia, [2e-5, 2e-5, 3e-5], rtol=1e-6)
    assert float(vehicle.thrust_constant) == float(small.thrust_constant)
    np.testing.assert_array_equal(vehicle.rotor_position, small.rotor_position)
