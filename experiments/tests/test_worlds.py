"""Worlds that aren't the simulator: the same start, one tick at a time."""

import jax
import numpy as np
import pytest

from experiments.flying.worlds.rotorpy import Bodies, crazyflie
from experiments.flying.worlds.study import make_world
from openjax.pursuit import Pursuit, PursuitSettings

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def start():
    environment = Pursuit(PursuitSettings(physics="rigid", start_attitude="level"))
    return jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(2), 2))[1]


@pytest.mark.parametrize("name", ["plant", "rotorpy"])
def test_worlds_fly_alike_for_a_moment(start, name):
    """The same numbers in, the same flight out, as far as vehicles are alike: hover,
    then a pitch rate.
    """
    if name == "rotorpy":
        pytest.importorskip("rotorpy")
    world = make_world(name, 20, 0, start.drones, start.task)
    position = np.asarray(start.drones.position)
    for poses in (world.poses(), world.measure()):
        np.testing.assert_allclose(poses["position"], position, atol=3e-3)
        assert poses["quaternion"].shape == (2, 3, 4)
    command = np.zeros((2, 3, 4))
    command[..., 0], command[..., 2] = 0.62, 1.0
    for _ in range(10):
        world.fly(command)
    after = world.poses()
    assert np.abs(after["position"] - position).max() < 0.03
    pitch = 2 * after["quaternion"][..., 2] / after["quaternion"][..., 0]
    np.testing.assert_allclose(pitch, 0.07, atol=0.04)  # 1 rad/s after the motors' lag
    np.testing.assert_allclose(world.measure()["position"], after["position"], atol=5e-3)


def test_rotorpy_at_once_is_rotorpy_one_by_one():
    """`Bodies` against `Multirotor.step` with a tight solver: vehicles that tumble,
    with every aerodynamic term.
    """
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    rng = np.random.default_rng(0)
    terms = {"c_Dx": 0.01, "c_Dz": 0.02, "k_h": 1e-4, "k_flap": 2e-7, "Ixy": 1e-6, "Ixz": -1.5e-6}
    exact = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
    model = multirotor.Multirotor(crazyflie() | terms, integrator_kwargs=exact)
    attitude = rng.normal(size=(4, 3))
    states = {
        "x": rng.normal(size=(3, 3)),
        "v": rng.normal(size=(3, 3)),
        "q": attitude / np.linalg.norm(attitude, axis=0),
        "w": 4 * rng.normal(size=(3, 3)),
        "rotor_speeds": rng.uniform(500, 2400, (4, 3)),
    }
    bodies = Bodies(model, states)
    alone = [{n: x[:, i] for n, x in states.items()} for i in range(3)]
    for _ in range(50):
        speeds = rng.uniform(0, 2600, (4, 3))  # some beyond what motors can
        bodies.step(speeds, 0.002)
        alone = [
            model.step(state | {"wind": np.zeros(3)}, {"cmd_motor_speeds": speeds[:, i]}, 0.002)
            for i, state in enumerate(alone)
        ]
    expected = [np.concatenate([state[name] for name in states]) for state in alone]
    np.testing.assert_allclose(bodies.state.T, expected, rtol=2e-6, atol=2e-6)
