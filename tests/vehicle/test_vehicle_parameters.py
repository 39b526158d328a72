"""The MJCF holds the numbers of the nominal Crazyflie, and anything else is refused
with a reason.
"""

import jax
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.pursuit import PursuitSettings, make
from openjax.vehicle import (
    hover_rotor_speed,
    hover_state,
    load_vehicle,
    max_rotor_thrust,
    register_airframe,
)
from openjax.vehicle.parameters import AIRFRAMES, assets_directory


def test_nominal_numbers_come_out_of_the_compiled_model():
    with jax.enable_x64(True):
        vehicle = jax.tree.map(np.asarray, load_vehicle(dtype="float64"))
    assert vehicle.mass == pytest.approx(0.0321)
    np.testing.assert_allclose(vehicle.inertia, [1.4e-5, 1.4e-5, 2.17e-5])
    np.testing.assert_allclose(np.linalg.norm(vehicle.rotor_position, axis=1), 0.043, rtol=1e-6)
    assert np.sign(vehicle.rotor_position).tolist() == [
        [1, -1, 0],
        [-1, -1, 0],
        [-1, 1, 0],
        [1, 1, 0],
    ]
    assert vehicle.rotor_spin.tolist() == [-1, 1, -1, 1]
    assert vehicle.torque_constant == pytest.approx(7.24e-10)
    assert max_rotor_thrust(vehicle) == pytest.approx(0.12596, rel=1e-5)
    assert 4 * max_rotor_thrust(vehicle) / (vehicle.mass * vehicle.gravity) == pytest.approx(
        1.60, abs=0.01
    )
    assert 4 * vehicle.thrust_constant * hover_rotor_speed(vehicle) ** 2 == pytest.approx(
        0.0321 * 9.81
    )
    np.testing.assert_allclose(vehicle.rate_kp, [250, 250, 120])
    np.testing.assert_allclose(vehicle.rate_integral_limit, [33.3, 33.3, 166.7])


def test_the_brushless_one_meets_its_sources():
    with jax.enable_x64(True):
        vehicle = jax.tree.map(np.asarray, load_vehicle("brushless", "float64"))
    assert vehicle.mass == pytest.approx(0.0434)
    np.testing.assert_allclose(np.linalg.norm(vehicle.rotor_position, axis=1), 0.05, rtol=1e-4)
    # crazyflow's curves of thrust and torque over rpm, from hover to the firmware's
    # largest thrust
    rpm = np.linspace(hover_rotor_speed(vehicle), vehicle.max_rotor_speed, 5) * 60 / (2 * np.pi)
    thrust = -3.133427e-7 * rpm + 4.407355e-10 * rpm**2
    torque = 1.658864e-9 * rpm + 2.469348e-12 * rpm**2
    speed = rpm * 2 * np.pi / 60
    np.testing.assert_allclose(vehicle.thrust_constant * speed**2, thrust, rtol=0.015)
    np.testing.assert_allclose(vehicle.torque_constant * speed**2, torque, rtol=0.04)
    assert max_rotor_thrust(vehicle) == pytest.approx(0.2, rel=1e-5)


def test_an_airframe_is_registered_from_outside(tmp_path, monkeypatch):
    monkeypatch.setattr("openjax.vehicle.parameters.AIRFRAMES", dict(AIRFRAMES))
    with pytest.raises(UserError, match="airframe mine: unknown; there are crazyflie, brushless"):
        PursuitSettings(airframe="mine")
    mjcf = tmp_path / "heavy.xml"
    shipped = (assets_directory() / "crazyflie.xml").read_text()
    mass = float(load_vehicle().mass)
    mjcf.write_text(shipped.replace(f'mass="{mass:g}"', f'mass="{2 * mass:g}"'))
    register_airframe("mine", mjcf)
    game = make(airframe="mine")
    assert float(game.vehicle.mass) == pytest.approx(2 * mass)
    register_airframe("mine", mjcf)  # a module that is loaded twice does no harm
    with pytest.raises(UserError, match="there is one of that name"):
        register_airframe("crazyflie", mjcf)


REPEATED = """<worldbody><replicate count="1000"><replicate count="1000"><geom size=".1"/>
</replicate></replicate>"""
LARGE = """<asset><texture type="2d" name="t" builtin="flat" width="100000" height="100000"/></asset>
<worldbody>"""


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda xml: xml.replace('name="rate_kp"', 'name="rate_gain"'), "no numeric named 'rate_kp'"),
        (lambda xml: xml.replace('data="250 250 120"', 'data="250 250"'), "holds 2 values"),
        (lambda xml: xml.replace('name="rotor_3" site', 'name="rotor" site'), "no actuator named 'rotor_3'"),
        (lambda xml: xml.replace("<inertial pos=\"0 0 0\"", "<inertial pos=\"0 0 0.01\""), "inertial frame"),
        (lambda xml: "nothing", "not a readable MJCF"),
        (lambda xml: xml.replace('data="0.025"', 'data="nan"'), "motor_time_constant is nan"),
        (lambda xml: xml.replace('data="0.025"', 'data="0"'), r"motor_time_constant is 0.0; it must be in \[1e-4"),
        (lambda xml: xml.replace('mass="0.0321"', 'mass="1e300"'), "mass is 1e"),
        (lambda xml: xml.replace("0 0 -9.81", "0 0 9.81"), "gravity is -9.81"),
        (lambda xml: xml.replace("0 0 -9.81", "1 0 -9.81"), "gravity .* along -z"),
        (lambda xml: xml.replace("2.350347e-8", "-2.350347e-8"), "thrust_constant is -2"),
        (lambda xml: xml.replace('gear="0 0 1 0 0 -0', 'gear="0 0 -1 0 0 -0', 1), "'rotor_1' must push along"),
        (lambda xml: xml.replace('name="rotor_2" pos', 'name="rotor_2" euler="180 0 0" pos'), "'rotor_2' must push along"),
        (lambda xml: xml.replace('pos="0.0304056 -0.0304056 0"', 'pos="0.0304056 0.0304056 0"'), "'rotor_1' is at"),
        (lambda xml: xml.replace("0 -0.0308", "0 0.0308", 1), "two must be positive"),
        (lambda xml: xml.replace("<worldbody>", REPEATED), "1e[+]06 copies"),
        (lambda xml: xml.replace("<worldbody>", LARGE), "1e[+]10 cells"),
    ],
)  # fmt: skip
def test_a_model_that_is_no_vehicle_is_refused(tmp_path, change, reason):
    path = tmp_path / "vehicle.xml"
    path.write_text(change((assets_directory() / "crazyflie.xml").read_text()))
    with pytest.raises(UserError, match=reason):
        load_vehicle(path)


def test_what_an_include_repeats_is_counted(tmp_path):
    text = (assets_directory() / "crazyflie.xml").read_text()
    (tmp_path / "vehicle.xml").write_text(
        text.replace("<worldbody>", '<include file="more.xml"/><worldbody>')
    )
    (tmp_path / "more.xml").write_text(
        '<mujoco><include file="vehicle.xml"/><worldbody><replicate count="100000000"><geom size=".1"/>'
        "</replicate></worldbody></mujoco>"
    )
    with pytest.raises(UserError, match=r"more\.xml: <replicate> asks for 1e[+]08 copies"):
        load_vehicle(tmp_path / "vehicle.xml")


def test_a_missing_model_is_refused(tmp_path):
    with pytest.raises(UserError, match="no such MJCF"):
        load_vehicle(tmp_path / "none.xml")


def test_hover_state_broadcasts():
    drones = hover_state(
        load_vehicle(), np.zeros((5, 3, 3)), quaternion=np.tile([1.0, 0, 0, 0], (3, 1))
    )
    assert drones.quaternion.shape == (5, 3, 4)
    assert drones.rotor_speed.shape == (5, 3, 4)
    assert {leaf.dtype for leaf in jax.tree.leaves(drones)} == {np.dtype("float32")}
