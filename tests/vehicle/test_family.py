"""Families of vehicles: what is drawn, that each drone flies its own, and what solid
things do to `stops`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.family import (
    VehicleRange,
    checked_ranges,
    draw_vehicles,
    family_bounds,
    family_effects,
    find_parameter,
    narrowed_bounds,
    standard_parameters,
    vehicle_family,
)
from openjax.vehicle.parameters import AIRFRAMES

KEY = jax.random.key(3)
SMALL = (
    VehicleRange("mass.extra", 0.0, 0.002, 0.004, 0.005),
    VehicleRange("motor_lag.extra_up", 0.01, 0.02, 0.05, 0.06),
    VehicleRange("motor_lag.extra_down", 0.01, 0.02, 0.05, 0.06),
)
NO_PILLARS = (jnp.zeros((0, 2)), jnp.zeros(0, bool))


def test_each_vehicle_is_drawn_from_its_ranges_and_one_effect_at_most_from_the_rare_ones():
    drawn = draw_vehicles(SMALL, KEY, 4000, rare=0.5)
    mass, up, down = drawn["mass"]["extra"], *drawn["motor_lag"].values()
    assert len(np.unique(mass)) > 3900
    heavy = mass > 0.003
    slow = up > 0.03
    # an effect is rare with all its parameters
    np.testing.assert_array_equal(slow, down > 0.03)
    assert not np.any(heavy & slow)
    np.testing.assert_allclose([heavy.mean(), slow.mean()], 0.25, atol=0.03)
    for name, low, high, rare_low, rare_high in SMALL:
        effect, _, parameter = name.partition(".")
        value = drawn[effect][parameter]
        assert np.all((value >= low) & (value <= high) | (value >= rare_low) & (value <= rare_high))
    assert draw_vehicles((), KEY, 3) == {}


@pytest.mark.parametrize("airframe", AIRFRAMES)
def test_standard_parameters_are_zero_without_the_effect(airframe):
    none = {}
    family = vehicle_family(airframe)
    for entry in family:
        effect, _, parameter = entry[0].partition(".")
        none.setdefault(effect, {})[parameter] = jnp.full(2, find_parameter(entry[0])[1].none)
    np.testing.assert_allclose(standard_parameters(family, none), 0.0, atol=1e-6)
    spread = np.std(standard_parameters(family, draw_vehicles(family, KEY, 500, 0.5)), axis=0)
    assert spread.min() > 0.01 and spread.max() < 3.0


def test_a_family_grows_from_the_nominal_vehicle():
    np.testing.assert_allclose(narrowed_bounds(SMALL, 0.0), 0.0)
    np.testing.assert_allclose(narrowed_bounds(SMALL, 1.0), family_bounds(SMALL))
    np.testing.assert_allclose(narrowed_bounds(SMALL, 0.5)[1], [0.005, 0.01, 0.025, 0.03])


@pytest.mark.parametrize(
    "entry",
    [
        ("mas.extra", 0, 1, 0, 1),
        ("mass.more", 0, 1, 0, 1),
        ("mass.extra", 1, 0, 0, 1),
        ("inertia.xx", -0.31, 0.97, 1.0, 1.0),
        ("motor_lag.extra_up", 0.0, 0.0, -0.03, 0.01),
    ],
)
def test_impossible_families_are_refused(entry):
    with pytest.raises(UserError):
        checked_ranges((entry,))


def test_a_drone_of_a_mixed_team_flies_as_in_a_team_of_its_own_kind():
    vehicle = load_vehicle()
    step = make_drones_step("rigid", substeps=2, effects=family_effects(SMALL), contacts=False)
    apart = jnp.array([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0]])
    start = step.reset(vehicle, hover_state(vehicle, apart), KEY)
    command = jnp.array([[0.8, 0.5, 0.2, 0.1]] * 2)
    fly = jax.jit(
        lambda drones, parameters: step(vehicle, drones, command, *NO_PILLARS, parameters)
    )
    mixed = {
        "mass": {"extra": jnp.array([0.0, 0.005])},
        "motor_lag": {"extra_up": jnp.array([0.05, 0.0])},
    }
    together = fly(fly(start, mixed), mixed)
    for i in range(2):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], mixed)
        alone = fly(fly(start, own), own)
        np.testing.assert_allclose(together.velocity[i], alone.velocity[i], rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(
            together.body_rates[i], alone.body_rates[i], rtol=1e-4, atol=1e-6
        )
    assert together.velocity[1, 2] != pytest.approx(float(together.velocity[0, 2]), abs=1e-4)


def test_stops_keeps_drones_out_of_floor_pillars_and_one_another():
    vehicle = load_vehicle()
    step = make_drones_step("stops")
    start = jnp.array([[-0.2, 0.0, 0.5], [0.6, 0.0, 0.1], [0.6, 0.11, 0.1]])
    velocity = jnp.array([[1.5, 0.0, 0.0], [0.0, 1.0, -2.0], [0.0, -1.0, -2.0]])
    pillars = (jnp.array([[0.0, 0.0], [9.0, 9.0]]), jnp.array([True, False]))
    command = jnp.zeros((3, 4)).at[:, 0].set(0.6)

    def one(drones, _):
        drones = step(vehicle, drones, command, *pillars)
        return drones, drones.position

    drones, path = jax.jit(lambda drones: jax.lax.scan(one, drones, length=40))(
        hover_state(vehicle, start, velocity=velocity)
    )
    assert np.linalg.norm(path[:, 0, :2], axis=-1).min() > 0.15 - 1e-4
    assert drones.position[0, 0] < -0.149  # stopped, not thrown back
    assert path[:, :, 2].min() > 0.05 - 1e-6
    assert np.linalg.norm(path[:, 1] - path[:, 2], axis=-1).min() > 0.1 - 1e-3
    free = jax.jit(step)(vehicle, hover_state(vehicle, start + 2.0), command, *pillars)
    same = jax.jit(make_drones_step("rigid"))(
        vehicle, hover_state(vehicle, start + 2.0), command, *pillars
    )
    np.testing.assert_allclose(free.position, same.position, atol=1e-6)
