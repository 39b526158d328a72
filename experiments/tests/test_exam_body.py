"""The exam's vehicle against closed forms: one body's mechanics, rotors, effects and firmware."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from experiments.diagnosis import injection, vehicle
from experiments.diagnosis.body import Body
from experiments.diagnosis.firmware import Filter

pytestmark = pytest.mark.slow


def body(parameters, q=None, velocity=None, rates=None, speed=0.0):
    count = len(parameters["mass"])
    q = np.tile([[1.0], [0], [0], [0]], (1, count)) if q is None else q
    zero = np.zeros((3, count))
    neutral = vehicle.nominal_parameters([vehicle.Told()] * count)
    return Body(
        parameters,
        neutral,
        np.array([[0.0], [0], [1.0]]) + zero,
        zero + (0.0 if velocity is None else np.array(velocity)[:, None]),
        q,
        zero + (0.0 if rates is None else np.array(rates)[:, None]),
        np.full((4, count), float(speed)),
    )


def steps(b, number, m=0.0):
    zero = np.zeros_like(b.rates)
    for _ in range(number):
        b.step(
            np.full((4, b.count), m), np.full(b.count, 3.7), np.full(b.count, 0.6), zero, zero, 0.0
        )


def test_a_vehicle_without_thrust_falls_and_turns_as_mechanics_says():
    p = vehicle.nominal_parameters([vehicle.Told()])
    b = body(p, velocity=[0.5, -0.2, 1.0], rates=[3.0, -2.0, 5.0])

    def momentum():
        return vehicle.rotate(b.q, b.principal * b.rates)

    def energy():
        return 0.5 * (b.principal * b.rates**2).sum()

    before = momentum()
    spin = energy()
    steps(b, 500)
    np.testing.assert_allclose(
        b.position[:, 0], [0.25, -0.1, 1.0 + 0.5 - 0.5 * 9.81 * 0.25], atol=1e-9
    )
    np.testing.assert_allclose(b.velocity[:, 0], [0.5, -0.2, 1.0 - 9.81 * 0.5], atol=1e-9)
    np.testing.assert_allclose(momentum(), before, rtol=0.01, atol=2e-7)
    assert energy() == pytest.approx(spin, rel=0.01)


def test_rotors_follow_a_step_with_their_lag_and_hover_carries_the_weight():
    p = vehicle.nominal_parameters([vehicle.Told(), vehicle.Told(motor_time=0.05)])
    b = body(p)
    steps(b, 25, m=0.25)
    share = b.rotor[0] / (vehicle.MAX_SPEED * 0.5)
    np.testing.assert_allclose(share, 1 - np.exp([-1.0, -0.5]), rtol=1e-6)
    heavy = vehicle.Told(mass=0.04, thrust_constant=3e-8)
    b = body(vehicle.nominal_parameters([heavy]), speed=vehicle.MAX_SPEED * np.sqrt(heavy.hover))
    steps(b, 10, m=heavy.hover)
    np.testing.assert_allclose(b.specific[:, 0], [0, 0, vehicle.GRAVITY], atol=1e-9)


def test_each_effect_pushes_as_its_formula_says():
    def specific(effect, size, form, shape=(0.25,) * 8, **state):
        p = vehicle.nominal_parameters([vehicle.Told()])
        injection.inject(
            {"effect": effect, "form": form, "size": size, "shape": list(shape)}, p, np.array([0])
        )
        b = body(p, speed=vehicle.MAX_SPEED * np.sqrt(vehicle.Told().hover), **state)
        steps(b, 1, m=vehicle.Told().hover)
        return b

    assert specific("thrust_scale", 0.1, "plain").specific[2, 0] == pytest.approx(1.1 * 9.81)
    assert specific("mass", 0.1, "plain").specific[2, 0] == pytest.approx(9.81 / 1.1)
    drag = specific("rotor_drag", 0.01, "linear", velocity=[1.0, 0, 0])
    assert drag.specific[0, 0] == pytest.approx(-0.01 / 0.0321)
    hubs = specific("rotor_drag", 0.01, "rotor_speed", velocity=[1.0, 0, 0])
    assert hubs.specific[0, 0] == pytest.approx(-0.01 / 0.0321, rel=1e-6)
    offset = specific(
        "com_offset", 1.0, "torque", shape=(0.0,) * 8
    )  # 1 mm forward: weight x arm about y
    assert offset.rates[1, 0] == pytest.approx(0.001 * 0.0321 * 9.81 / 1.4e-5 * 0.001, rel=1e-3)
    still = specific("wind", 1.0, "steady", shape=(0.0,) * 8)
    assert still.specific[0, 0] == pytest.approx(0.008 / 0.0321)


def test_the_firmware_filter_is_a_butterworth_and_starts_at_rest():
    rng = np.random.default_rng(0)
    signal = rng.standard_normal((200, 3, 1))
    own = Filter(np.array([80.0]), 3, np.zeros((3, 1)))
    got = np.stack([own(x) for x in signal])
    want = lfilter(*butter(2, 80.0, fs=500.0), signal, axis=0)
    np.testing.assert_allclose(got, want, atol=1e-12)
    constant = Filter(np.array([30.0]), 3, np.full((3, 1), 2.0))
    np.testing.assert_allclose(constant(np.full((3, 1), 2.0)), 2.0)


def test_a_propeller_that_speeds_up_turns_the_body_and_keeps_the_whole_momentum():
    p = vehicle.nominal_parameters([vehicle.Told(torque_ratio=1e-12)])
    p["propeller_inertia"][:] = 4e-8
    p["rotor_gain"][:, 0] = [1.0, 0.0, 1.0, 0.0]
    b = body(p)
    zero = np.zeros((3, 1))
    b.step(np.array([[0.5], [0], [0.5], [0]]), np.array([3.7]), np.array([0.6]), zero, zero, 0.0)
    # a clockwise rotor turns about -z
    spins = (-vehicle.SPIN[:, None] * b.rotor).sum() * 4e-8
    assert b.rates[2, 0] * b.principal[2, 0] == pytest.approx(-spins, rel=1e-6)
