"""Both physics against MuJoCo C, which is driven through the site actuators of the
MJCF.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from openjax.vehicle import (
    hover_state,
    load_vehicle,
    make_drones_step,
    max_rotor_thrust,
    rotor_thrust,
)
from openjax.vehicle.parameters import find_mjcf

STEPS = 100
QPOS = np.array([0.0, 0.0, 30.0, 0.9, 0.1, -0.3, 0.2])
QVEL = np.array([1.0, 2.0, 0.5, 3.0, -5.0, 8.0])


def hard_manoeuvres():
    """(STEPS, 1, 4) commands that jump ten times a second, into the saturation of
    motors and controller.
    """
    draw = np.random.default_rng(0)
    jumps = np.concatenate(
        [draw.uniform(0.2, 0.95, (10, 1)), draw.uniform(-1, 1, (10, 3)) * [20, 20, 10]], axis=1
    )
    return np.repeat(jumps, STEPS // 10, axis=0)[:, None]


@pytest.mark.parametrize(
    ("airframe", "physics", "contacts", "substeps"),
    [
        ("crazyflie", "rigid", False, 1),
        ("crazyflie", "mjx", False, 1),
        ("crazyflie", "mjx", True, 1),
        ("crazyflie", "rigid", False, 2),
        ("brushless", "rigid", False, 1),
        # what is the vehicle's and what is the engine's is each held by a row above
        pytest.param("brushless", "mjx", True, 1, marks=pytest.mark.slow),
    ],
)
def test_a_second_of_hard_manoeuvres(airframe, physics, contacts, substeps):
    with jax.enable_x64(True):
        vehicle = load_vehicle(airframe, jnp.float64)
        step = make_drones_step(physics, dt=0.01 * substeps, substeps=substeps, contacts=contacts)
        quaternion = QPOS[3:] / np.linalg.norm(QPOS[3:])
        start = hover_state(vehicle, QPOS[None, :3], quaternion[None], QVEL[None, :3])
        start = start.replace(body_rates=jnp.asarray(QVEL[None, 3:]))
        pillars = jnp.array([[0.2, 0.1], [0.3, -0.4]]), jnp.zeros(2, bool)

        def advance(drones, command):
            drones = step(vehicle, drones, command, *pillars)
            return drones, drones

        commands = jnp.asarray(hard_manoeuvres())[::substeps]
        _, flown = jax.jit(lambda start: jax.lax.scan(advance, start, commands))(start)
        thrust = np.asarray(
            jax.vmap(lambda speed: rotor_thrust(vehicle, speed))(flown.rotor_speed[:, 0])
        )
        if substeps > 1:  # what goes on within a step isn't seen from outside
            thrust = inner_thrusts(vehicle, start, commands, substeps)
        most = float(max_rotor_thrust(vehicle))
        flown = jax.tree.map(np.asarray, flown)

    model = mujoco.MjModel.from_xml_path(str(find_mjcf(airframe)))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.r_[QPOS[:3], quaternion], QVEL
    assert thrust.max() > 0.95 * most, "the manoeuvres must reach saturation"
    for k in range(STEPS):
        data.ctrl[:] = thrust[k]
        mujoco.mj_step(model, data)
        if (k + 1) % substeps == 0:
            j = (k + 1) // substeps - 1
            np.testing.assert_allclose(flown.position[j, 0], data.qpos[:3], rtol=0, atol=1e-9)
            np.testing.assert_allclose(flown.quaternion[j, 0], data.qpos[3:], rtol=0, atol=1e-9)
            np.testing.assert_allclose(flown.velocity[j, 0], data.qvel[:3], rtol=0, atol=1e-9)
            np.testing.assert_allclose(flown.body_rates[j, 0], data.qvel[3:], rtol=0, atol=1e-9)
    assert np.linalg.norm(data.qvel[3:]) > 5, "the manoeuvres must turn fast"


def inner_thrusts(vehicle, start, commands, substeps):
    """(STEPS, 4) thrusts of a flight in shorter steps, which substeps must equal."""
    step = make_drones_step("rigid", dt=0.01, contacts=False)
    none = jnp.zeros((0, 2)), jnp.zeros(0, bool)

    def advance(drones, command):
        drones = step(vehicle, drones, command, *none)
        return drones, drones.rotor_speed[0]

    _, speed = jax.jit(
        lambda: jax.lax.scan(advance, start, jnp.repeat(commands, substeps, axis=0))
    )()
    return np.asarray(vehicle.thrust_constant * speed**2)
