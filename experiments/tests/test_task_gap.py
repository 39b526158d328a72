"""The gap in the task: wakes and solid things of a team in the plant, the game around poses from outside, the flights."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.diagnosis import cases, vehicle
from experiments.task_gap import flights
from experiments.worlds import game
from experiments.worlds import plant as air
from openjax.flights.case import load_case
from openjax.pursuit import Pursuit, PursuitSettings


def test_a_vehicle_under_two_others_bears_both_wakes():
    """Partners mixed up, or one of a team forgotten, would leave the lowest with one wake, or give the top one any."""
    environment = Pursuit(PursuitSettings(physics="rigid", start_attitude="level"))
    _, state = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(2), 2))
    stacked = jnp.array([[0.0, 0.0, 0.3], [0.0, 0.0, 0.9], [0.0, 0.0, 0.6]])
    drones = state.drones.replace(position=jnp.stack([stacked, stacked[::-1] * 1.1]))
    cause = {"effect": "downwash", "form": "gaussian", "size": 10.0, "shape": [0.5] * 8}
    world = air.PlantWorld(drones, state.task, 5, 1, 0, cause)
    world.flight.air["gust_force"] *= 0
    world.flight.send(world.flight.start)  # hover
    world.flight.step()
    lost = vehicle.GRAVITY - world.flight.body.specific[2]

    def pull(away):
        return 0.010 / vehicle.MASS * vehicle.GRAVITY * np.exp(-away / 0.5)

    lowest, highest = pull(0.3) + pull(0.6), 0.0
    want = [lowest, highest, pull(0.3), pull(0.33), highest, pull(0.33) + pull(0.66)]
    np.testing.assert_allclose(lost, want, atol=0.02 * vehicle.GRAVITY)  # the thrust is off by up to 0.8 %


def test_solids_stop_and_keep_momentum():
    """Nothing sinks into floor, pillar or neighbour; two drones that meet keep their common momentum."""
    position = np.array([[0.0, 0.0, 0.04], [0.3, 0.0, 0.5], [0.38, 0.01, 0.5], [-0.13, 0.0, 0.5]]).T
    velocity = np.array([[0.1, 0, -1.0], [0.5, 0, 0], [-0.5, 0, 0.1], [1.0, 0.2, 0]]).T
    pillar = np.zeros((2, 1, 4))
    active = np.array([[False, False, False, True]])
    momentum = velocity[:, 1] + velocity[:, 2]
    air.Solids(pillar, active, team=4).stop(position, velocity)
    assert position[2, 0] >= air.RADIUS and velocity[2, 0] >= 0 and velocity[0, 0] == 0.1
    assert np.linalg.norm(position[:, 1] - position[:, 2]) > 2 * air.RADIUS - 1e-9
    np.testing.assert_allclose(velocity[:, 1] + velocity[:, 2], momentum)
    between = position[:, 2] - position[:, 1]
    assert between @ (velocity[:, 2] - velocity[:, 1]) > -1e-9
    np.testing.assert_allclose(position[:, 3], [-0.15, 0, 0.5])
    np.testing.assert_allclose(velocity[:, 3], [0, 0.2, 0], atol=1e-9)


def test_game_around_outside_poses_is_the_game():
    """Fed with the poses of the simulator's own drones, the game gives the simulator's observations and counts."""
    settings = PursuitSettings(physics="rigid", episode_length=20)
    inside, outside = Pursuit(settings), game.flown_pursuit(settings)
    key = jax.random.key(5)
    _, state = jax.jit(inside.reset)(key)
    _, other = jax.jit(outside.reset)(key)
    action = jnp.array([[0.1, 0.2, 0.0, 0.3], [1.0, -1.0, 0.1, 0.0], [-1.0, 0.0, 0.4, 0.0]])

    @jax.jit
    def both(state, other):
        observation, state, *_ = inside.step(key, state, action)
        flown = game.pose_of(state.drones)
        other = other.replace(drones=game.remember(other.drones, flown, flown))
        seen, other, *_ = outside.step(key, other, action)
        return observation, state, seen, other

    for _ in range(settings.episode_length):
        observation, state, seen, other = both(state, other)
    for a, b in zip(jax.tree.leaves(observation), jax.tree.leaves(seen), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    for a, b in zip(jax.tree.leaves(state.statistics), jax.tree.leaves(other.statistics), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


def test_cases_differ_in_form_and_keep_their_vehicle():
    drawn = flights.make_cases(9, replicates=2, nones=1, effects=("motor_lag", "rotor_drag"))
    assert [c.effect for c in drawn] == ["motor_lag", "motor_lag", "rotor_drag", "rotor_drag", "none"]
    assert drawn[0].cause["form"] != drawn[1].cause["form"]
    assert len({c.number for c in drawn}) == len(drawn)
    again = flights.make_cases(9, replicates=1, nones=0, effects=("rotor_drag",))[0]
    assert again.cause == drawn[2].cause and again.spec()["sensors"] == drawn[2].spec()["sensors"]


def test_flights_of_a_case_can_be_diagnosed(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "TICKS", 300)
    case = flights.make_cases(3, replicates=1, nones=0, effects=("downwash",))[0]
    said = flights.write_flights(case, tmp_path)
    assert any(m[0] in cases.missions.PAIR for m in case.missions) and said["magnitudes"]["A_g"] == 16.0
    loaded = load_case(tmp_path)
    assert said["ticks"] == [295] * 3  # a flight ends before its log is full
    assert len(loaded.flights) == 6 and {len(f.time) for f in loaded.flights} == {295}
