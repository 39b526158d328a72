"""Free flight, controller and motors against closed forms; precision and gradients of
the step.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.vehicle import (
    hover_state,
    load_vehicle,
    make_drones_step,
    max_rotor_thrust,
    rigid_step,
    rotate,
    rotor_speed_step,
)
from openjax.vehicle.rate_controller import rate_controller

NO_PILLARS = jnp.zeros((0, 2)), jnp.zeros(0, bool)


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle()


@pytest.fixture(scope="module")
def fly(vehicle):
    """fly(start, command (N, 4), 100 n): states of a flight by `rigid`, compiled
    once.
    """
    step = make_drones_step("rigid", contacts=False)

    @jax.jit
    def second(start, command):
        def advance(drones, _):
            drones = step(vehicle, drones, command, *NO_PILLARS)
            return drones, drones

        return jax.lax.scan(advance, start, None, length=100)

    def flight(start, command, seconds):
        parts = []
        for _ in range(seconds):
            start, states = second(start, command)
            parts.append(states)
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    return flight


def test_momentum_and_energy_without_forces():
    with jax.enable_x64(True):
        vehicle = load_vehicle(dtype=jnp.float64)
        start = hover_state(vehicle, jnp.zeros(3), velocity=jnp.array([1.0, -2, 3]))
        start = start.replace(body_rates=jnp.array([4.0, -3, 6]))
        zero = jnp.zeros(3)
        dt = 1e-4

        def advance(drone, _):
            return rigid_step(vehicle, drone, zero, zero, dt), None

        end = jax.jit(lambda drone: jax.lax.scan(advance, drone, None, length=10_000)[0])(start)

        def spin(drone):
            angular = vehicle.inertia * drone.body_rates
            return rotate(drone.quaternion, angular), 0.5 * jnp.sum(drone.body_rates * angular)

        (momentum0, energy0), (momentum1, energy1) = spin(start), spin(end)
    assert np.linalg.norm(end.body_rates - start.body_rates) > 1, (
        "the body must tumble for this to mean anything"
    )
    np.testing.assert_allclose(momentum1, momentum0, atol=2e-3 * np.linalg.norm(momentum0))
    np.testing.assert_allclose(energy1, energy0, rtol=2e-3)
    # a free fall
    np.testing.assert_allclose(end.velocity, [1, -2, 3 - 9.81], rtol=1e-9)
    np.testing.assert_allclose(end.position, [1, -2, 3 - 0.5 * 9.81 * (1 + dt)], rtol=1e-9)


def test_hover_holds_for_eight_seconds(vehicle, fly):
    start = hover_state(vehicle, jnp.array([[0.0, 0, 0.5]]))
    hover = vehicle.mass * vehicle.gravity / (4 * max_rotor_thrust(vehicle))
    states = fly(start, jnp.array([[hover, 0, 0, 0]]), 8)
    assert (
        np.abs(states.position - [0, 0, 0.5]).max() < 2e-3
    )  # float32 thrust is off by some 1e-7 of the weight
    assert np.abs(states.body_rates).max() < 1e-3
    assert np.abs(np.linalg.norm(states.quaternion, axis=-1) - 1).max() < 1e-6


@pytest.mark.parametrize(
    ("axis", "rate"), [(0, 1.5), (0, -1.5), (1, 1.5), (1, -1.5), (2, 0.8), (2, -0.8)]
)
def test_body_rates_settle_on_the_command(vehicle, fly, axis, rate):
    start = hover_state(vehicle, jnp.array([[0.0, 0, 5.0]]))
    command = jnp.array([[0.62, 0, 0, 0]]).at[0, 1 + axis].set(rate)
    rates = fly(start, command, 1).body_rates[:, 0]
    assert rates[4, axis] * rate > 0, "the first response must have the command's sign"
    assert np.abs(rates[-30:, axis] - rate).max() < 0.1 * abs(rate)
    assert np.abs(rates[:, axis]).max() < 1.5 * abs(rate)
    assert np.abs(np.delete(rates, axis, axis=1)).max() < 0.1


@pytest.mark.parametrize(("thrust", "sign"), [(0.8, 1), (0.4, -1)])
def test_thrust_sets_the_climb(vehicle, fly, thrust, sign):
    start = hover_state(vehicle, jnp.array([[0.0, 0, 5.0]]))
    velocity = fly(start, jnp.array([[thrust, 0, 0, 0]]), 1).velocity[:, 0]
    acceleration = (velocity[-1] - velocity[-11]) / 0.1
    assert sign * velocity[5, 2] > 0
    expected = thrust * 4 * max_rotor_thrust(vehicle) / vehicle.mass - vehicle.gravity
    np.testing.assert_allclose(acceleration, [0, 0, expected], atol=0.02)


@pytest.mark.parametrize(("axis", "up"), [(0, [2, 3]), (1, [1, 2]), (2, [1, 3])])
def test_mixer_raises_the_right_motors(vehicle, axis, up):
    """+roll lifts the left, +pitch the rear, +yaw speeds up the clockwise rotors."""
    state = jax.tree.map(lambda leaf: leaf[0], hover_state(vehicle, jnp.zeros((1, 3))))
    motors, integral = rate_controller(
        vehicle, state, jnp.array([0.5, 0, 0, 0]).at[1 + axis].set(0.3), 0.01
    )
    assert sorted(np.flatnonzero(motors > 0.5)) == up
    assert integral[axis] == pytest.approx(np.degrees(0.3) * 0.01, rel=1e-5)


def test_rate_controller_by_hand(vehicle):
    """One sample of the firmware's PID: 16-bit counts from errors in degrees per
    second.
    """
    state = jax.tree.map(lambda leaf: leaf[0], hover_state(vehicle, jnp.zeros((1, 3))))
    degree = np.pi / 180
    state = state.replace(
        body_rates=jnp.array([2.0, 0, 0]) * degree, previous_body_rates=jnp.array([1.0, 0, 0]) * degree,
        rate_integral=jnp.array([5.0, 40, 0]),
    )  # fmt: skip
    motors, integral = rate_controller(vehicle, state, jnp.array([0.5, 12 * degree, 0, 0]), 0.01)
    np.testing.assert_allclose(integral, [5.1, 33.3, 0], rtol=1e-5)
    roll = 250 * 10 + 500 * 5.1 - 2.5 * 100
    pitch = 500 * 33.3
    by_hand = [32768 - roll / 2 - pitch / 2, 32768 - roll / 2 + pitch / 2, 32768 + roll / 2 + pitch / 2,
               32768 + roll / 2 - pitch / 2]  # fmt: skip
    np.testing.assert_allclose(motors * 65536, by_hand, rtol=1e-4)


def test_motor_lag_is_exact(vehicle):
    start = jnp.full(4, 1000.0)
    target = float(vehicle.max_rotor_speed) * np.sqrt(0.5)
    once = rotor_speed_step(vehicle, start, jnp.full(4, 0.5), 0.02)
    twice = rotor_speed_step(
        vehicle, rotor_speed_step(vehicle, start, jnp.full(4, 0.5), 0.01), jnp.full(4, 0.5), 0.01
    )
    expected = target + (1000.0 - target) * np.exp(-0.02 / 0.025)
    np.testing.assert_allclose(once, expected, rtol=1e-5)
    np.testing.assert_allclose(twice, once, rtol=1e-5)


@pytest.mark.slow
def test_gradients_are_right_and_finite(vehicle):
    """By MJX among solids as by the written-out equations; finite on the floor, where a
    contact acts, and at full stop of a rotor, where the square root of the command has
    no slope.
    """
    pillars = jnp.array([[0.5, 0.0]]), jnp.ones(1, bool)

    def slopes(physics):
        step = make_drones_step(physics)

        def end(thrust, mass, height):
            start = hover_state(vehicle, jnp.zeros((1, 3)).at[:, 2].set(height))
            command = jnp.zeros((1, 4)).at[:, 0].set(thrust).at[:, 1].set(3.0)
            drones = step(vehicle.replace(mass=mass), start, command, *pillars)
            return jnp.sum(drones.position[:, 2]) + jnp.sum(drones.body_rates[:, 0])

        return jax.jit(jax.grad(end, argnums=(0, 1, 2)))

    rigid = slopes("rigid")
    mjx = slopes("mjx")
    np.testing.assert_allclose(
        mjx(0.7, vehicle.mass, 1.0), rigid(0.7, vehicle.mass, 1.0), rtol=1e-3
    )
    assert np.all(np.abs(rigid(0.7, vehicle.mass, 1.0)) > 1e-3)
    for thrust, height in ((0.0, 1.0), (0.5, 0.05), (0.0, 0.049)):
        assert np.isfinite(mjx(thrust, vehicle.mass, height)).all()
        assert np.isfinite(rigid(thrust, vehicle.mass, height)).all()


def test_precision_is_that_of_the_state(vehicle):
    """No leaf changes its dtype or becomes weakly typed: a step is the carry of a scan,
    whatever x64 says.
    """
    start = hover_state(vehicle, jnp.array([[0.0, 0, 0.5], [0.5, 0, 0.5]]))
    for physics, contacts in (("rigid", False), ("mjx", True)):
        for x64 in (False, True):
            with jax.enable_x64(x64):
                step = make_drones_step(physics, contacts=contacts, substeps=2)
                pillars = jnp.zeros((1, 2), jnp.float32), jnp.ones(1, bool)
                command = jnp.zeros((2, 4))
                end = jax.eval_shape(step, vehicle, start, command, *pillars)
            for before, after in zip(jax.tree.leaves(start), jax.tree.leaves(end), strict=True):
                assert (after.dtype, after.shape, after.weak_type) == (
                    before.dtype,
                    before.shape,
                    False,
                )


@pytest.mark.parametrize(
    "wrong", [{"physics": "warp"}, {"dt": 0.0}, {"substeps": 0}, {"effects": ("magic",)}]
)
def test_an_impossible_step_is_refused(wrong):
    with pytest.raises(UserError):
        make_drones_step(**wrong)
