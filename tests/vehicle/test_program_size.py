"""The step is a small program: what vmaps it into a program of their own waits for its
compiler.
"""

import jax
import jax.numpy as jnp
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr

import openjax
from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.rigid_kernel import kernel_call

VEHICLE = load_vehicle()


def equations(jaxpr) -> int:
    """Of a traced function and of all functions in it."""
    inner = jax.tree.leaves(
        [list(equation.params.values()) for equation in jaxpr.eqns],
        is_leaf=lambda leaf: isinstance(leaf, ClosedJaxpr | Jaxpr),
    )
    jaxprs = [leaf for leaf in inner if isinstance(leaf, ClosedJaxpr | Jaxpr)]
    return len(jaxpr.eqns) + sum(
        equations(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner) for inner in jaxprs
    )


def test_environment_step():
    """A ceiling that may only be lowered."""
    game = openjax.make(physics="rigid")
    state = jax.eval_shape(game.reset, jax.random.key(0))[1]
    traced = jax.make_jaxpr(game.step)(jax.random.key(0), state, jnp.zeros((3, 4)))
    assert equations(traced.jaxpr) <= 1150


@pytest.mark.parametrize("drones", [3, 6])
@pytest.mark.parametrize("pillars", [5, 10])
def test_kernel_does_not_grow_with_drones_and_pillars(drones, pillars):
    """4,295 equations with three drones and five pillars took a GPU's compiler half a
    minute.
    """
    step = make_drones_step("rigid").fused_step
    team = hover_state(VEHICLE, jnp.zeros((256, drones, 3)))
    command = jnp.zeros((256, drones, 4))
    solids = (jnp.zeros((256, pillars, 2)), jnp.zeros((256, pillars), bool))
    traced = jax.make_jaxpr(lambda *world: kernel_call(step, VEHICLE, *world))(
        team, command, solids
    )
    assert equations(traced.jaxpr) <= 1020
