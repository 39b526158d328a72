"""The velocity controller on the vehicle, and heuristics as policies like any other."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import openjax
from openjax.baselines import DacoopPolicy, Heuristic, VelocityPolicy, velocity_action
from openjax.baselines.apf import apf
from openjax.baselines.dacoop import START
from openjax.baselines.surroundings import Craft, surroundings
from openjax.commands.evaluate import main
from openjax.errors import UserError
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings, Task

HONEST = Pursuit(PursuitSettings(physics="rigid", speed_limit="none", num_pursuers=2))
APART = Task(
    pursuer_position=jnp.array([[-0.5, 0.0, 0.5], [0.5, 0.3, 0.7]]),
    evader_position=jnp.array([-0.2, 0.5, 0.5]),
    pillar_position=jnp.zeros((5, 2)),
    pillar_active=jnp.zeros(5, bool),
)


def test_the_velocity_controllers_step_response():
    """From tilted rest to full speed along an axis and back to hover: fast, hardly
    overshooting, height kept.
    """
    craft = Craft.of(HONEST)

    @jax.jit
    def fly(desired):
        def one(carry, desired):
            observation, state = carry
            action = velocity_action(craft, observation, jnp.broadcast_to(desired, (2, 3)))
            observation, state, *_ = HONEST.step(jax.random.key(0), state, action)
            return (observation, state), (state.drones.velocity, state.drones.position)

        return jax.lax.scan(one, HONEST.reset_to(jax.random.key(1), APART), desired)[1]

    steps = jnp.zeros((220, 3)).at[60:140, 0].set(1.0)
    velocity, position = (np.asarray(leaf) for leaf in fly(steps))
    assert np.abs(velocity[59]).max() < 0.05, "drawn attitudes are levelled"
    assert velocity[60 + 30, :, 0].min() > 0.75
    assert 0.97 < velocity[120:140, :, 0].min() and velocity[..., 0].max() < 1.03
    assert np.abs(velocity[-1]).max() < 0.05
    assert np.abs(velocity[60:, :, 1]).max() < 0.05
    assert np.ptp(position[40:, :, 2], axis=0).max() < 0.06


def test_surroundings_are_what_the_observation_says():
    craft = Craft.of(HONEST)

    def one(carry, _):
        observation, state = carry
        desired = jnp.array([[0.5, 0.0, 0.0], [0.0, -0.5, 0.0]])
        observation, state, *_ = HONEST.step(
            jax.random.key(0), state, velocity_action(craft, observation, desired)
        )
        return (observation, state), None

    start = jax.jit(HONEST.reset_to)(jax.random.key(1), APART)
    (observation, state), _ = jax.jit(lambda start: jax.lax.scan(one, start, None, length=60))(
        start
    )
    known = jax.jit(lambda observation: surroundings(craft, observation))(observation)
    velocity = np.asarray(state.drones.velocity)
    np.testing.assert_allclose(known.target_velocity[1], state.evader_velocity, atol=1e-6)
    np.testing.assert_allclose(
        known.from_others_velocity[0, 0], velocity[0] - velocity[1], atol=0.1
    )
    np.testing.assert_allclose(known.team_velocity[0], velocity.mean(axis=0), atol=0.05)
    # where all will be after the vehicle's response, straight on
    later = np.asarray(state.drones.position) + craft.response * velocity
    np.testing.assert_allclose(known.position, later, atol=1e-5)
    np.testing.assert_allclose(known.floor_distance, later[:, 2], atol=1e-5)
    np.testing.assert_allclose(known.from_others[0, 0], later[0] - later[1], atol=0.02)
    target = np.asarray(state.evader_position + craft.response * state.evader_velocity)
    np.testing.assert_allclose(known.target[0], target, atol=1e-5)
    place = np.asarray(state.drones.position)[:, :2]
    outward = place / np.linalg.norm(place, axis=-1, keepdims=True)
    to_wall = 0.9 - np.sum(outward * later[:, :2], axis=-1)
    np.testing.assert_allclose(known.obstacle_distance[:, -1], to_wall, atol=1e-5)
    assert np.isinf(known.obstacle_distance[:, :-1]).all()


@pytest.mark.parametrize(
    ("changes", "complaint"), [({"time_step": 0.05}, "control steps"), ({"mass": 1.5}, "hovers at")]
)
def test_a_heuristic_says_what_it_cannot_fly(changes, complaint):
    environment = Pursuit(PursuitSettings(physics="rigid"))
    if "mass" in changes:
        vehicle = environment.vehicle.replace(mass=changes["mass"] * environment.vehicle.mass)
        environment = Pursuit(environment.settings, vehicle)
    else:
        environment = openjax.make(physics="rigid", **changes)
    with pytest.raises(UserError, match=complaint):
        Heuristic.for_environment("apf", environment)
    with pytest.raises(UserError, match=complaint):
        DacoopPolicy.for_environment(
            environment, NetworkSettings(output="field"), PredictorSettings(enabled=False)
        )


def test_a_velocity_policy_flies_the_velocity_that_its_network_puts_out():
    """Where it asks for more than the drones may fly, their largest speed."""
    network = NetworkSettings(output="velocity", squash="mean")
    predictor = PredictorSettings(enabled=False)
    policy = VelocityPolicy.for_environment(HONEST, network, predictor)
    sample = jnp.array([[0.3, -0.4, 0.0], [2.0, 1.0, 0.0]])

    def one(carry, _):
        observation, state = carry
        observation, state, *_ = HONEST.step(
            jax.random.key(0), state, policy.action(sample, observation)
        )
        return (observation, state), None

    start = jax.jit(HONEST.reset_to)(jax.random.key(1), APART)
    (_, state), _ = jax.jit(lambda start: jax.lax.scan(one, start, None, length=80))(start)
    diagonal = policy.craft.speed / np.sqrt(2.0)
    expected = [
        [0.3 * policy.craft.speed, -0.4 * policy.craft.speed, 0.0],
        [diagonal, diagonal, 0.0],
    ]
    np.testing.assert_allclose(state.drones.velocity, expected, atol=0.05)
    with pytest.raises(UserError, match="control steps"):
        VelocityPolicy.for_environment(
            openjax.make(physics="rigid", time_step=0.05), network, predictor
        )


def test_dacoop_flies_the_field_that_its_network_sets():
    environment = Pursuit(PursuitSettings(physics="rigid"))
    policy = DacoopPolicy.for_environment(
        environment, NetworkSettings(features=16, output="field"), PredictorSettings(enabled=False)
    )
    heuristic = Heuristic.for_environment("apf", environment)
    observation, _ = jax.jit(environment.reset)(jax.random.key(0))
    start = jnp.broadcast_to(jnp.tanh(jnp.array(policy.initial_action)), (3, policy.sample_size))
    fly = jax.jit(policy.action)
    action = fly(start, observation)

    @jax.jit
    def follow(observation):
        desired = apf(heuristic.craft, START, surroundings(heuristic.craft, observation))
        return velocity_action(heuristic.craft, observation, desired)

    expected = follow(observation)
    np.testing.assert_allclose(action, expected, atol=1e-3)
    # another balance, other commands: what the network puts out matters
    assert np.abs(fly(start.at[:, 1].add(-0.8), observation) - action).max() > 0.05


def test_evaluation_through_the_command(tmp_path, capsys):
    out = tmp_path / "out.json"
    options = [
        "--environment.physics",
        "rigid",
        "--environment.episode_length",
        "40",
        "--episodes",
        "4",
    ]
    assert main(["--policy", "apf", "--scenario", "empty", "--json", str(out), *options]) == 0
    record = json.loads(out.read_text())
    assert (
        record["scenario"] == "empty"
        and record["episodes"] == 4
        and record["prediction_error"] is None
    )
    assert record["collision_rate"] < 0.2 and record["over_speed_rate"] == 0.0
    with pytest.raises(UserError, match="control steps"):
        main(["--policy", "janosov", "--scenario", "wall", "--environment.time_step", "0.05"])
    with pytest.raises(UserError, match="control steps"):
        main(["--policy", "dacoop_seed_0", "--scenario", "wall", "--environment.time_step", "0.05"])
    with pytest.raises(UserError, match="angelani"):
        main(["--policy", "angelany", "--scenario", "wall"])
