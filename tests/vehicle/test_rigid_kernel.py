"""The rigid step of many drones: its kernel (in interpret mode), its maps and its
derivatives against the mapped step.
"""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.kernels.componentwise import evaluate, split
from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.rigid_kernel import DRONES, WORTH, kernel_call, mapped_step

pytestmark = pytest.mark.slow

VEHICLE = load_vehicle()
FREE = make_drones_step(physics="rigid", dt=0.01, substeps=2, contacts=False)
AMONG_SOLIDS = make_drones_step(physics="rigid", dt=0.01)
NO_PILLARS = jnp.zeros((1, 2)), jnp.zeros(1, bool)


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
    command = jax.random.uniform(keys[7], (*lead, 4), minval=-0.2, maxval=1.2) * jnp.array(
        [1.0, 9, 9, 9]
    )
    return structure.unflatten(leaves), command


def crowded(worlds):
    """Worlds of two drones close to the floor, each other and two pillars, of which one
    isn't there.
    """
    drones, command = drawn(worlds, 2)
    position = drones.position * jnp.array([0.05, 0.05, 0.01]) + jnp.array([0, 0, 0.06])
    pillars = jnp.array([[0.2, 0.0], [-0.1, -0.1]])
    active = jnp.array([True, False])
    lead = (worlds, *pillars.shape)
    drones = drones.replace(position=position)
    return (drones, command, (jnp.broadcast_to(pillars, lead), jnp.broadcast_to(active, lead[:2])))


def assert_close(got, expected, tolerance=2e-5):
    chex.assert_trees_all_close(got, expected, rtol=tolerance, atol=tolerance)


def fly(vehicle, drones, command):
    return FREE(vehicle, drones, command, *NO_PILLARS)


def fly_plainly(vehicle, drones, command):
    """The formulas of free flight, of drones (n, ...)."""
    return mapped_step(FREE.fused_step, vehicle, drones, command, ())


def by_kernel(fused, drones, command, pillars=()):
    return jax.jit(lambda *given: kernel_call(fused, VEHICLE, *given, interpret=True))(
        drones, command, pillars
    )


@jax.jit
def freely(drones, command):
    return jax.vmap(lambda d, c: fly_plainly(VEHICLE, d, c))(drones, command)


def test_kernel_computes_the_step_of_each_drone():
    drones, command = drawn(DRONES + 5, 1)  # the last block is only partly filled
    assert_close(by_kernel(FREE.fused_step, drones, command), freely(drones, command))


def test_kernel_computes_contacts():
    drones, command, pillars = crowded(DRONES + 5)
    among = AMONG_SOLIDS.fused_step
    stepped = by_kernel(among, drones, command, pillars)
    plainly = jax.jit(jax.vmap(lambda *world: mapped_step(among, VEHICLE, *world)))
    expected = plainly(drones, command, pillars)
    assert_close(stepped, expected, 1e-4)
    free = freely(drones, command)
    assert (np.abs(free.velocity - expected.velocity).max(-1) > 0.1).mean() > 0.5, (
        "most must touch something"
    )


def test_mapped_over_worlds_and_over_vehicles():
    drones, command = drawn(5, 3)
    expected = freely(drones, command)
    assert_close(jax.jit(jax.vmap(lambda d, c: fly(VEHICLE, d, c)))(drones, command), expected)
    one_command = jax.jit(jax.vmap(lambda d: fly(VEHICLE, d, command[0])))(drones)
    assert_close(
        one_command, jax.jit(jax.vmap(lambda d: fly_plainly(VEHICLE, d, command[0])))(drones)
    )
    heavier = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.2 * leaf]), VEHICLE)
    first = jax.tree.map(lambda leaf: leaf[0], drones)
    both = jax.jit(jax.vmap(lambda vehicle: fly(vehicle, first, command[0])))(heavier)
    for i in range(2):
        vehicle = jax.tree.map(lambda leaf, i=i: leaf[i], heavier)
        got = jax.tree.map(lambda leaf, i=i: leaf[i], both)
        assert_close(got, jax.jit(fly_plainly)(vehicle, first, command[0]))


def test_memory_of_effects_that_the_step_does_not_have_is_left_alone():
    drones, command = drawn(3)
    memory = {"delay": jnp.arange(30.0).reshape(3, 5, 2), "age": jnp.arange(3)}
    step = jax.jit(fly)
    stepped = step(VEHICLE, drones.replace(effect_memory=memory), command)
    chex.assert_trees_all_equal(stepped.effect_memory, memory)
    assert_close(stepped.replace(effect_memory=()), step(VEHICLE, drones, command))


def test_worlds_become_more_worlds_of_one_call(monkeypatch):
    drones, command, pillars = crowded(6)

    def step(drones, command, pillars):
        return AMONG_SOLIDS(VEHICLE, drones, command, *pillars)

    twice = jax.tree.map(
        lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), (drones, command, pillars)
    )
    got = jax.jit(jax.vmap(jax.vmap(step)))(*twice)
    expected = jax.jit(
        jax.vmap(lambda *world: mapped_step(AMONG_SOLIDS.fused_step, VEHICLE, *world))
    )(drones, command, pillars)
    assert_close(jax.tree.map(lambda leaf: leaf.reshape(6, *leaf.shape[2:]), got), expected)
    monkeypatch.setattr("openjax.platform.can_compile_for_cuda", lambda: True)
    many = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((2, WORTH // 2, *leaf.shape[2:]), leaf.dtype), twice
    )
    traced = str(jax.make_jaxpr(jax.vmap(jax.vmap(step)))(*many))
    assert f"f32[{WORTH},2,3]" in traced and "platform_index" in traced


@pytest.mark.parametrize("argument", ["vehicle", "command"])
def test_derivatives_are_those_of_the_step(argument):
    drones, command = drawn(4)

    def height(step, mass, command):
        vehicle = VEHICLE.replace(mass=mass)
        return jnp.sum(step(vehicle, drones, command).velocity[:, 2] ** 2)

    place = {"vehicle": 1, "command": 2}[argument]
    got = jax.jit(jax.grad(partial(height, fly), place - 1))(VEHICLE.mass, command)
    expected = jax.jit(jax.grad(partial(height, fly_plainly), place - 1))(VEHICLE.mass, command)
    np.testing.assert_allclose(got, expected, rtol=1e-4)
    assert np.abs(expected).max() > 0


def test_componentwise_moves_sums_and_compares():
    def function(x, y):
        first, second = jax.lax.unstack(
            jnp.stack([x, y])
        )  # what newer versions of JAX make of `first, second = ...`
        table = jnp.stack([first, second[::-1], jnp.where(x > 0.1, x, y)]).T
        return jnp.sum(table * jnp.array([1.0, -2.0, 0.5]), axis=1), jnp.concatenate(
            [table[1], x[:1]]
        ).reshape(2, 2)

    x, y = (jax.random.normal(jax.random.key(i), (7, 3)) for i in range(2))
    results = evaluate(jax.make_jaxpr(function)(x[0], y[0]), [split(x.T), split(y.T)])
    for got, expected in zip(results, jax.vmap(function)(x, y), strict=True):
        blocks = [jnp.broadcast_to(block, 7) for block in got.ravel()]
        np.testing.assert_allclose(
            np.stack(blocks, -1).reshape(expected.shape), expected, rtol=1e-6
        )


def test_what_mixes_components_otherwise_is_named():
    with pytest.raises(NotImplementedError, match="sort"):
        evaluate(jax.make_jaxpr(jnp.sort)(jnp.zeros(3)), [split(jnp.zeros((3, 7)))])
