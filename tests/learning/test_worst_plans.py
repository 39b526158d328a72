"""The last stage's evaders that plan: what they try, that they fly the worst of it, and
that the pursuers learn from that.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.learning import AnalyticSettings, GeneratorSettings, build
from openjax.learning.gradient.last_flights import LastFlights
from openjax.learning.gradient.measures import SmoothFlight, free_flight
from openjax.learning.gradient.stage import GradientStage, Turn, update
from openjax.learning.gradient.worst_plans import WARM_UP, WorstPlans, planning_game
from openjax.learning.presets import preset
from openjax.learning.settings import WorstPlansSettings
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit, PursuitSettings


class Short(WorstPlansSettings):
    """Few short plans."""

    PLANS = 9
    PIECES = 3
    PIECE_SECONDS = 0.03
    TEAM_PLANS = 3


HOW = Short(worlds=2)


def make_stage(updates):
    """A stage of a small network, whose policy has no parameters yet."""
    game = free_flight(Pursuit(PursuitSettings(physics="rigid", max_pillars=4)))
    policy = Policy.for_environment(
        game, NetworkSettings(features=8, heads=1), PredictorSettings(enabled=False)
    )
    usual = LastFlights(AnalyticSettings(updates=updates, worlds=4), SmoothFlight(game, policy))
    return WorstPlans(HOW, planning_game(game), usual, GeneratorSettings())


def test_what_evaders_try():
    class Many(Short):
        PLANS = 400

    stage = dataclasses.replace(make_stage(4), planning=Many(worlds=2))
    plan = jax.random.normal(jax.random.key(0), (5, 3, 3))
    tried = np.asarray(stage.search.candidates(jax.random.key(1), plan))
    assert tried.shape == (5, 400, 3, 3)
    np.testing.assert_array_equal(tried[:, 0], plan)
    np.testing.assert_array_equal(tried[:, 1], np.asarray(plan)[:, [1, 2, 2]])
    assert (tried[:, 2] == 0.0).all()
    assert np.isnan(tried[:, 3]).all()
    ways = tried[:, 4:]
    np.testing.assert_allclose(np.linalg.norm(ways, axis=-1), 1.0, atol=1e-5)
    same = (ways[:, :, 1:] == ways[:, :, :-1]).all(-1)
    straight = 396 // 3
    assert same[:, :straight].all()
    assert same[:, straight:].mean() == pytest.approx(0.5, abs=0.05)


def test_the_first_steps_are_small():
    stage = make_stage(200)
    gradient = {"weight": jnp.ones(7)}
    state = stage.optimiser.init(gradient)
    sizes = []
    for _ in range(2 * WARM_UP):
        change, state = stage.optimiser.update(gradient, state)
        sizes.append(float(jnp.max(jnp.abs(change["weight"]))))
    rate = stage.usual.settings.learning_rate
    assert sizes[0] <= rate / WARM_UP
    assert max(sizes) == pytest.approx(rate, rel=0.05)
    assert np.argmax(sizes) == pytest.approx(WARM_UP, abs=1)


@pytest.fixture(scope="module")
def flown():
    """A stage, its parameters and what it carries."""
    stage = make_stage(4)
    observation, _ = jax.jit(stage.environment.reset)(jax.random.key(0))
    parameters = jax.jit(stage.flight.policy.init)(jax.random.key(1), observation)
    return stage, parameters, jax.jit(stage.begin)(jax.random.key(2))


@pytest.mark.slow
def test_the_worst_plan_is_the_worst_of_those_tried(flown):
    stage, parameters, carried = flown
    plan = 0.7 * jax.random.normal(jax.random.key(3), carried.plan.shape)
    key = jax.random.key(4)
    trials = jax.jit(stage.attempts)(parameters.actor, parameters, carried.world, plan, key)
    step = jax.jit(stage.environment.step)
    act = jax.jit(stage.flight.policy.act)
    for world in range(HOW.worlds):
        promises = []
        tried = stage.search.candidates(key, plan)[world]
        for pieces in tried:
            start = jax.tree.map(lambda leaf, world=world: leaf[world], carried.world)
            observation, state = start
            for wish in jnp.repeat(pieces, stage.search.settings.piece_steps, axis=0):
                action = act(parameters, observation)
                observation, state, *_ = step(None, state, action, wish)
            promises.append(float(stage.search.promise(start[1], state)))
        np.testing.assert_allclose(trials.promise[world], promises, atol=1e-3)
        np.testing.assert_allclose(trials.best[world], tried[int(np.argmax(promises))], atol=1e-5)


@pytest.mark.slow
def test_pursuers_learn_from_the_worst_plan(flown):
    lesson, parameters, _ = flown
    stage = GradientStage(lesson)
    one = jax.jit(functools.partial(update, stage.programs))
    carry = jax.jit(stage.begin)(parameters, jax.random.key(2))
    flights = jax.jit(lesson.record)(parameters, jax.random.key(5))
    turn = Turn(carry, parameters, flights, jax.random.key(6))
    after, parts = one(turn)
    assert jax.tree.structure(after) == jax.tree.structure(carry)
    assert all(np.isfinite(value) for value in parts.values())
    # worlds are a piece of the plan later, the plan is what is left of it
    steps = np.asarray(after.lesson.world[1].step)
    assert set(steps) <= {0, lesson.search.settings.piece_steps}
    # Adam's first step has a rate of zero, the second doesn't
    after, _ = one(turn._replace(carry=after, key=jax.random.key(7)))
    moved = jax.tree.map(lambda a, b: jnp.any(a != b), after.actor.parameters, parameters.actor)
    assert any(jax.tree.leaves(moved))


@pytest.mark.slow
def test_the_game_that_is_shipped_can_be_learnt_with_team_plans():
    settings = preset("evaders", worst_plans=dict(worlds=2))
    game = dataclasses.replace(settings.environment, evaders=("field",))
    environment = free_flight(Pursuit(game))
    policy = build(settings, environment).policy
    usual = LastFlights(settings.analytic, SmoothFlight(environment, policy))
    lesson = WorstPlans(HOW, planning_game(environment), usual, settings.generator)
    stage = GradientStage(lesson)

    def whole(key):
        parameters = policy.init(key, environment.reset(key)[0])
        carry = stage.begin(parameters, key)
        flights = lesson.record(parameters, key)
        return carry, update(stage.programs, Turn(carry, parameters, flights, key))

    # its shapes alone: vehicles' ranges, say, can't be checked inside a program
    before, (after, parts) = jax.eval_shape(whole, jax.random.key(0))
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert {"planned_follow", "planned_gain"} <= set(parts)


@pytest.mark.slow
def test_nothing_is_learnt_of_an_evader_that_nobody_sees(flown):
    stage, parameters, carried = flown
    observation, state = carried.world
    hidden = observation, state.replace(in_sight=jnp.zeros_like(state.in_sight))
    plan = jnp.ones_like(carried.plan)

    def parts(world):
        return stage.loss(parameters.actor, parameters, world, plan)[1][1]

    seen, unseen = jax.jit(parts)(carried.world), jax.jit(parts)(hidden)
    assert seen["free"] > 0.0 or not np.any(state.in_sight)
    assert unseen["free"] == unseen["distance"] == 0.0
    assert unseen["crashes"] == seen["crashes"]
