"""The stage before MAPPO: its game is the run's, and what it teaches brings pursuers
nearer to the evader.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import pytest

from openjax.learning import preset
from openjax.learning.gradient.first_flights import FirstFlights, first_game
from openjax.learning.gradient.measures import (
    SmoothFlight,
    crash_share,
    evader_distance,
    free_share,
    nearest_distance,
    tip_share,
)
from openjax.learning.gradient.stage import GradientStage
from openjax.learning.settings import FirstFlightsSettings
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.shortest_paths import shortest_paths


class Small(FirstFlightsSettings):
    """Few short worlds."""

    WORLDS = 4
    STEPS = 2
    ANEW = 0.5


GAME = PursuitSettings(
    physics="rigid",
    num_pursuers=2,
    min_pillars=0,
    max_pillars=1,
    start_attitude="level",
    evader_speed=0.8,
)


def test_a_second_of_the_stage_is_a_second_of_the_game():
    how = FirstFlightsSettings()
    for name in ("quick", "paper", "flight"):
        game = preset(name).environment
        own = first_game(Pursuit(game), how).settings
        assert own.time_step == pytest.approx(how.TIME_STEP)
        assert own.episode_length * own.time_step == pytest.approx(
            game.episode_length * game.time_step
        )
        assert not own.contacts and own.speed_limit == game.speed_limit


@pytest.mark.slow
def test_pursuers_come_nearer():
    class Fast(FirstFlightsSettings):
        WORLDS = 48
        STEPS = 15
        LEARNING_RATE = 5e-3
        CRASH = 20.0
        CRASH_SMOOTH = 0.012
        BREACH = 10.0

    how = Fast(updates=160)
    environment = first_game(Pursuit(GAME), how)
    policy = Policy.for_environment(
        environment,
        NetworkSettings(features=16, heads=1, squash="sample"),
        PredictorSettings(enabled=False),
    )
    stage = GradientStage(FirstFlights(how, SmoothFlight(environment, policy)))
    observation, _ = jax.jit(environment.reset)(jax.random.key(0))
    parameters = jax.jit(policy.init)(jax.random.key(1), observation)
    carry = jax.jit(stage.begin)(parameters, jax.random.key(2))
    some = jax.jit(stage.several(20))
    distances = []
    for done in range(0, 120, 20):
        carry, parts = some(carry, parameters, jax.random.key(3), done)
        assert all(jnp.isfinite(value) for value in parts.values())
        distances.append(float(parts["distance"]))
    assert distances[-1] < 0.75 * distances[0]
    # nobody is caught yet: penalties wait
    assert carry.lesson.ramp == 0.0


def test_a_game_without_pillars_can_be_learnt():
    how = Small(updates=1)
    environment = first_game(Pursuit(dataclasses.replace(GAME, max_pillars=0)), how)
    networks = NetworkSettings(features=8, heads=1), PredictorSettings(enabled=False)
    flight = SmoothFlight(environment, Policy.for_environment(environment, *networks))
    stage = GradientStage(FirstFlights(how, flight))

    def learn(key):
        parameters = flight.policy.init(key, environment.reset(key)[0])
        return stage.several(1)(stage.begin(parameters, key), parameters, key, 0)[1]

    assert "distance" in jax.eval_shape(learn, jax.random.key(0))


@pytest.mark.slow
def test_two_devices_learn_what_one_does():
    how = Small(updates=2)
    environment = first_game(Pursuit(GAME), how)
    networks = NetworkSettings(features=8, heads=1), PredictorSettings(enabled=False)
    flight = SmoothFlight(environment, Policy.for_environment(environment, *networks))
    one = GradientStage(FirstFlights(how, flight))
    two = GradientStage(FirstFlights(how, flight, axis="devices"))
    observation, _ = jax.jit(environment.reset)(jax.random.key(0))
    parameters = jax.jit(flight.policy.init)(jax.random.key(1), observation)
    key = jax.random.key(2)

    @jax.jit
    def both(parameters, key):
        shares = functools.partial(jax.vmap, axis_name="devices", axis_size=2)

        def learn(stage):
            return stage.several(1)(stage.begin(parameters, key), parameters, key, 0)

        return learn(one), shares(lambda: learn(two), in_axes=())()

    (carry, parts), (their_carry, their_parts) = both(parameters, key)
    for leaf, theirs in zip(
        jax.tree.leaves(carry.lesson.world), jax.tree.leaves(their_carry.lesson.world), strict=True
    ):
        if leaf.dtype == jnp.float32:
            assert jnp.allclose(leaf, theirs.reshape(leaf.shape), atol=1e-5)
    for leaf, theirs in zip(
        jax.tree.leaves((carry.actor.parameters, parts)),
        jax.tree.leaves((their_carry.actor.parameters, their_parts)),
        strict=True,
    ):
        assert jnp.allclose(theirs, leaf, atol=1e-5)


def test_an_evader_within_reach_is_not_free():
    state = jax.jit(jax.vmap(Pursuit(GAME).reset))(jax.random.split(jax.random.key(0), 4))[1]
    near = state.drones.position.at[:, 0].set(state.evader_position + jnp.array([0.1, 0.0, 0.0]))
    near = state.replace(drones=state.drones.replace(position=near))
    distance = jax.jit(
        lambda s: evader_distance(
            GAME, s, jax.vmap(functools.partial(shortest_paths, GAME))(s.task)
        )
    )
    far = distance(state)
    near = distance(near)
    assert near[:, 0] == pytest.approx(0.1, abs=1e-3)
    assert (free_share(GAME.capture_radius, near) < 0.2).all() and (
        free_share(GAME.capture_radius, near) < free_share(GAME.capture_radius, far)
    ).all()


def test_one_near_pursuer_lets_others_be_far():
    distance = jnp.array([[0.5, 0.5, 0.5], [0.0, 1.0, 1.0]])
    assert nearest_distance(distance) == pytest.approx([0.5, 0.15 * math.log(3.0)], abs=1e-3)
    pull = jax.jit(jax.grad(lambda d: nearest_distance(d)[0]))(distance[1:])[0]
    assert pull[0] > 0.99 and pull[1] < 0.01


def test_a_tip_over_counts_as_a_touch_does():
    assert (
        tip_share(jnp.cos(jnp.deg2rad(60.0))) < 0.01 < 0.99 < tip_share(jnp.cos(jnp.deg2rad(100.0)))
    )
    assert crash_share(jnp.array(0.1)) < 0.01 < 0.5 < crash_share(jnp.array(0.0))
    assert crash_share(jnp.array(0.1), 0.05) > 0.1  # felt earlier
