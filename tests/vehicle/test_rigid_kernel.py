"""The rigid step of many drones: its kernel (in interpret mode), its maps and its derivatives against the mapped step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.componentwise import evaluate, split
from openjax.vehicle.rigid_kernel import DRONES, kernel_call, step_many

VEHICLE = load_vehicle()
STEP = make_drones_step(physics="rigid", dt=0.01, substeps=2)
ONE = STEP.free_flight


def drawn(*lead):
    """Drones in fast turns, their commands at and beyond the controller's limits."""
    keys = jax.random.split(jax.random.key(0), 8)
    drones = hover_state(VEHICLE, jnp.zeros((*lead, 3)))
    leaves, structure = jax.tree.flatten(drones)
    scales = (1.0, 1.0, 2.0, 8.0, 500.0, 20.0, 8.0)
    leaves = [
        leaf + scale * jax.random.normal(key, leaf.shape)
        for leaf, scale, key in zip(leaves, scales, keys, strict=False)
    ]
    command = jax.random.uniform(keys[7], (*lead, 4), minval=-0.2, maxval=1.2) * jnp.array([1.0, 9, 9, 9])
    return structure.unflatten(leaves), command


def assert_close(got, expected):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)


def fly(vehicle, drones, command):
    return STEP(vehicle, drones, command, jnp.zeros((1, 2)), jnp.zeros(1, bool))


def test_kernel_computes_the_step_of_each_drone():
    drones, command = drawn(DRONES + 5)  # the last block is only partly filled
    stepped = kernel_call(ONE, VEHICLE, drones, command, interpret=True)
    assert_close(stepped, jax.vmap(ONE, (None, 0, 0))(VEHICLE, drones, command))


def test_mapped_over_worlds_and_over_vehicles():
    drones, command = drawn(5, 3)
    expected = jax.vmap(jax.vmap(ONE, (None, 0, 0)), (None, 0, 0))(VEHICLE, drones, command)
    assert_close(jax.vmap(lambda d, c: fly(VEHICLE, d, c))(drones, command), expected)
    one_command = jax.vmap(lambda d: fly(VEHICLE, d, command[0]))(drones)
    assert_close(
        one_command, jax.vmap(jax.vmap(ONE, (None, 0, 0)), (None, 0, None))(VEHICLE, drones, command[0])
    )
    heavier = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.2 * leaf]), VEHICLE)
    first = jax.tree.map(lambda leaf: leaf[0], drones)
    both = jax.vmap(lambda vehicle: fly(vehicle, first, command[0]))(heavier)
    for i in range(2):
        vehicle = jax.tree.map(lambda leaf, i=i: leaf[i], heavier)
        assert_close(
            jax.tree.map(lambda leaf, i=i: leaf[i], both),
            jax.vmap(ONE, (None, 0, 0))(vehicle, first, command[0]),
        )


def test_memory_of_effects_that_the_step_does_not_have_is_left_alone():
    drones, command = drawn(3)
    memory = {"delay": jnp.arange(30.0).reshape(3, 5, 2), "age": jnp.arange(3)}
    stepped = fly(VEHICLE, drones.replace(effect_memory=memory), command)
    jax.tree.map(np.testing.assert_array_equal, stepped.effect_memory, memory)
    assert_close(stepped.replace(effect_memory=()), fly(VEHICLE, drones, command))


def test_worlds_become_more_drones_of_one_call():
    drones, command = drawn(6, 3)
    traced = str(jax.make_jaxpr(jax.vmap(lambda d, c: step_many(ONE, VEHICLE, d, c)))(drones, command))
    assert "f32[18,3]" in traced and "platform_index" in traced


@pytest.mark.parametrize("argument", ["vehicle", "command"])
def test_derivatives_are_those_of_the_step(argument):
    drones, command = drawn(4)

    def height(step, mass, command):
        vehicle = VEHICLE.replace(mass=mass)
        return jnp.sum(step(vehicle, drones, command).velocity[:, 2] ** 2)

    place = {"vehicle": 1, "command": 2}[argument]
    got = jax.grad(height, place)(fly, VEHICLE.mass, command)
    expected = jax.grad(height, place)(jax.vmap(ONE, (None, 0, 0)), VEHICLE.mass, command)
    np.testing.assert_allclose(got, expected, rtol=1e-4)
    assert np.abs(expected).max() > 0


def test_componentwise_moves_sums_and_compares():
    def function(x, y):
        table = jnp.stack([x, y[::-1], jnp.where(x > 0.1, x, y)]).T
        return jnp.sum(table * jnp.array([1.0, -2.0, 0.5]), axis=1), jnp.concatenate(
            [table[1], x[:1]]
        ).reshape(2, 2)

    x, y = (jax.random.normal(jax.random.key(i), (7, 3)) for i in range(2))
    results = evaluate(jax.make_jaxpr(function)(x[0], y[0]), [split(x.T), split(y.T)])
    for got, expected in zip(results, jax.vmap(function)(x, y), strict=True):
        blocks = [jnp.broadcast_to(block, 7) for block in got.ravel()]
        np.testing.assert_allclose(np.stack(blocks, -1).reshape(expected.shape), expected, rtol=1e-6)


def test_what_mixes_components_otherwise_is_named():
    with pytest.raises(NotImplementedError, match="sort"):
        evaluate(jax.make_jaxpr(jnp.sort)(jnp.zeros(3)), [split(jnp.zeros((3, 7)))])
