"""Training of teams of different sizes: everything that learns takes worlds with empty
slots.
"""

import chex
import jax
import jax.numpy as jnp

from openjax.learning import TrainSettings, build, changed, make_start, make_training_step
from openjax.learning.gradient.first_flights import FirstFlights, first_game
from openjax.learning.gradient.last_flights import LastFlights
from openjax.learning.gradient.measures import SmoothFlight, free_flight
from openjax.learning.gradient.stage import GradientStage
from openjax.learning.gradient.worst_plans import WorstPlans, planning_game
from openjax.learning.settings import AnalyticSettings, FirstFlightsSettings, WorstPlansSettings

SETTINGS = changed(
    TrainSettings(),
    environment=dict(
        num_pursuers=4,
        team_sizes=(1, 2, 4),
        evader_speeds=(0.8, 2.0),
        capture_radii=(0.2, 0.4),
        arena_radii=(0.8, 1.2),
        fall_outs=0.5,
        observe_game=True,
        observe_arena=True,
        history_pursuers="pooled",
        evaders=("field", "greedy", "learned"),
        physics="stops",
        episode_length=8,
        history_length=3,
    ),
    network=dict(features=8, heads=2, shared_encoder=True),
    predictor=dict(units=4, windows=2, horizons=(1, 2)),
    mappo=dict(minibatches=2),
    generator=dict(capacity=8, episodes_per_task=2),
    num_envs=8,
    rollout_length=4,
    restart_every=2,
    restart_steps=4,
    restart_close=0.5,
    total_steps=320,
)


def test_a_training_step_of_teams_keeps_its_carry():
    start = make_start(SETTINGS)
    carry = jax.eval_shape(start, jax.random.key(0))
    after, metrics = jax.eval_shape(make_training_step(SETTINGS), carry)
    chex.assert_trees_all_equal_shapes_and_dtypes(carry, after)
    assert carry.observation.active.shape == (8, 4)
    assert carry.archive.tasks.active.shape == (8, 4)
    assert "learned_capture_rate" in metrics


def test_stages_by_the_gradient_take_teams():
    parts = build(SETTINGS)
    worlds = FirstFlightsSettings(updates=1)
    game = first_game(parts.environment, worlds)
    stage = GradientStage(FirstFlights(worlds, SmoothFlight(game, parts.policy)))

    def first(key):
        parameters = parts.policy.init(key, parts.environment.reset(key)[0])
        carry = stage.begin(parameters, key)
        return stage.several(1)(carry, parameters, key, 0)[1], carry.lesson.world

    shares, world = jax.eval_shape(first, jax.random.key(0))
    assert shares["breaches"].shape == () and world[1].task.active.shape == (worlds.WORLDS, 4)

    how = AnalyticSettings(updates=1, worlds=4)
    lesson = LastFlights(how, SmoothFlight(free_flight(parts.environment), parts.policy))

    def last(key):
        parameters = parts.policy.init(key, parts.environment.reset(key)[0])
        starts = lesson.starts(key, lesson.bounds())
        return lesson.loss(parameters.actor, parameters, starts, starts)

    total, _ = jax.eval_shape(last, jax.random.key(0))
    assert total.shape == () and total.dtype == jnp.float32

    planning = WorstPlansSettings(worlds=2)
    game = planning_game(free_flight(parts.environment))
    against_plans = WorstPlans(planning, game, lesson, SETTINGS.generator)

    def at_the_worst_plan(key):
        parameters = parts.policy.init(key, parts.environment.reset(key)[0])
        state = against_plans.begin(key)
        loss = against_plans.loss(parameters.actor, parameters, state.world, state.plan)
        return loss[0]

    total = jax.eval_shape(at_the_worst_plan, jax.random.key(0))
    assert total.shape == () and total.dtype == jnp.float32
