"""Learning the first moments of an episode by the gradient through the simulation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.learning import recovery as module
from openjax.learning.recovery import Recovery, RecoverySettings, side_by_side
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task
from openjax.pursuit.task import starts_clear
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import VehicleRange, family_bounds

GAME = PursuitSettings(
    num_pursuers=2,
    min_pillars=0,
    max_pillars=1,
    vehicles=(VehicleRange("mass.extra", 0.0, 0.004, 0.0, 0.004),),
)


def test_all_stand_side_by_side():
    game = dataclasses.replace(GAME, num_pursuers=3)
    keys = jax.random.split(jax.random.key(0), 64)
    before = jax.vmap(lambda key: uniform_task(game, key))(keys)
    tasks = jax.vmap(lambda key, task: side_by_side(game, key, task))(keys, before)
    position = np.asarray(tasks.pursuer_position)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 9 * np.eye(3)
    moved = (position != np.asarray(before.pursuer_position)).any((1, 2))
    assert moved.mean() > 0.5
    assert (apart[moved].min(2) < game.drone_clearance + module.APART + 1e-4).all()
    near = dataclasses.replace(
        game, drone_clearance=game.drone_clearance - 0.01
    )  # outside the arena counts, too
    clear = jax.vmap(
        lambda task: starts_clear(dataclasses.replace(near, arena_radius=9.0, arena_height=9.0), task)
    )
    assert np.asarray(clear(tasks))[moved].all()


def test_the_gradient_leads_away_from_crashes(monkeypatch):
    monkeypatch.setattr(module, "STEPS", 12)
    environment, vehicle = Pursuit(GAME), load_vehicle()
    policy = Policy.for_environment(
        environment, NetworkSettings(features=16, heads=1), PredictorSettings(enabled=False)
    )
    parameters = policy.init(jax.random.key(0), environment.reset(jax.random.key(1))[0])
    recovery = Recovery(GAME, vehicle, policy, parameters)
    bounds = jnp.broadcast_to(jnp.asarray(family_bounds(GAME.vehicles)), (32, 1, 4))
    starts = recovery.starts(jax.random.key(2), 32, bounds)
    how = RecoverySettings(hold=0.0)
    loss = jax.jit(jax.value_and_grad(lambda actor: recovery.loss(how, actor, actor, starts, starts)))
    before, gradient = loss(parameters.actor)
    size = sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(gradient)) ** 0.5
    assert np.isfinite(size) and size > 0
    moved = jax.tree.map(lambda leaf, slope: leaf - 0.05 / size * slope, parameters.actor, gradient)
    assert loss(moved)[0] < before - 0.3 * 0.05 * size
    still = loss(parameters.actor)[0]
    assert still == pytest.approx(float(before))
