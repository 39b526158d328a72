"""The gap in the task: the air stepped tick by tick against the plant, the game around poses from outside, the figures."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from experiments.task_gap import flights
from experiments.withheld import body, cases, causes, plant
from experiments.worlds import game
from experiments.worlds import plant as air
from openjax.pursuit import Pursuit, PursuitSettings

TICKS = 60


@pytest.mark.parametrize(
    "effect, form",
    [
        ("motor_lag", "second_order"),
        ("state_latency", "jitter"),
        ("packet_loss", "bursts"),
        ("inertia", "products"),
        ("downwash", "jet"),
        ("rate_gains", "filtered_d"),
    ],
)
def test_air_is_the_plant(effect, form):
    """Commanded by the plant's own controller, every tick is that of `plant.fly`, to rounding."""
    rng = np.random.default_rng(1)
    cause = causes.draw(rng, effect, form) | {"size": causes.LIMITS[effect][1]}
    spec = {"number": 1, "flights": [("pass",), ("agile",)], "mass_weighed": False}
    flown_by = cases.Flights(3, [spec])
    count = flown_by.count
    p = body.nominal_parameters(count)
    arrival = np.repeat(10.0 * np.arange(TICKS)[:, None], count, axis=1)
    causes.apply(cause, p, np.arange(count), arrival, np.random.default_rng(2))
    reference = {name: value[:TICKS] for name, value in flown_by.reference.items()}
    want = plant.fly(plant.Batch(p, reference, flown_by.partner, arrival, flown_by.noise))
    assert (want["crashed"] == TICKS).all()

    half = 0.5 * reference["yaw"][0]
    start = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    bodies = air.Air(p, flown_by.noise, arrival, reference["position"][0], start, [flown_by.partner])
    integral = np.zeros((3, count))
    for k in range(TICKS):
        for name, value in (("position", bodies.position), ("quaternion", bodies.q), ("rotor", bodies.rotor)):
            np.testing.assert_allclose(
                want[name][k], value, rtol=1e-6, atol=1e-6, err_msg=f"{name}, tick {k}"
            )
        position, q, velocity = bodies.measure()
        command = plant.off_board_control(reference, k, position, q, velocity, integral, body.MASS)
        bodies.fly(command)


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
    _, state = inside.reset(key)
    _, other = outside.reset(key)
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
    assert again.cause == drawn[2].cause and again.shared["thrust_offset"] == drawn[2].shared["thrust_offset"]
