"""Judges: what their evaders sense, and that one that plans gets away where it can."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.networks import apply_network, init_network, likeliest, ways
from openjax.evaluation.judges.planner import Planner
from openjax.evaluation.judges.senses import number_of_senses, sense, to_world
from openjax.evaluation.judges.settings import BestResponseSettings, PlannerSettings
from openjax.evaluation.judges.tasks import draw_own_task
from openjax.pursuit import turn_task, uniform_task
from tests.learning.points import Team, game_of_points

KEY = jax.random.key(0)
GAME = game_of_points(max_pillars=3, episode_length=80)


def straight(observation):
    """At the evader."""
    to_evader = -observation.self_state[..., :3]
    return to_evader / jnp.linalg.norm(to_evader, axis=-1, keepdims=True)


@jax.jit
def state_of(task):
    """At the start of a task, everything level and the evader on its way outwards."""
    state = GAME.reset_to(jax.random.key(1), task)[1]
    level = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (3, 4))
    outward = jnp.pad(task.evader_position[:2], (0, 1))
    drones = state.drones.replace(quaternion=level, velocity=0.1 * task.pursuer_position)
    # what was seen turns with the world
    return state.replace(
        drones=drones, evader_velocity=outward, last_seen=task.evader_position, step=jnp.int32(7)
    )


def test_units_that_a_narrow_learner_has_not_got_stay_without_use():
    settings = BestResponseSettings(learners=4, widths=(6, 3))
    widths = [settings.width_of(learner) for learner in range(4)]
    ways = {(width, settings.sees_in_world(i)) for i, width in enumerate(widths)}
    assert len(ways) == 4, "each width sees in both kinds of axes"
    network = init_network(KEY, widths, (5, 2))
    inputs = jax.random.normal(KEY, (4, 7, 5))

    def loss(network):
        return jnp.sum(jnp.sin(apply_network(network, inputs) + 1.0))

    gradient = jax.jit(jax.grad(loss))(network)
    for name, axes in (("kernel_0", (2,)), ("kernel_1", (1, 2)), ("kernel_2", (1,))):
        for axis in axes:
            spare = jax.lax.slice_in_dim(gradient[name][1], 3, 6, axis=axis - 1)
            assert not jnp.any(spare), name
        assert jnp.any(gradient[name][0])


def test_learners_are_kept_at_their_looks_and_at_the_end():
    settings = BestResponseSettings(
        learners=2, num_envs=16, rollout_length=4, total_steps=5 * 512, looks=(300, 900, 10**9)
    )
    assert settings.steps_per_update == 512 and settings.total_updates == 5
    assert settings.updates_of_looks == [1, 4, 5]


@pytest.mark.parametrize("world_axes", [True, False])
def test_in_its_own_axes_a_turned_world_is_the_same(world_axes):
    task = jax.jit(lambda key: uniform_task(GAME.settings, key))(jax.random.key(0))
    # heights turn with nothing: a velocity that has one would tell the worlds apart
    task = task.replace(pursuer_position=task.pursuer_position.at[:, 2].set(0.5))
    states = [state_of(task), state_of(jax.jit(turn_task)(jax.random.key(2), task))]
    look = jax.jit(lambda state: sense(GAME.settings, state, jnp.bool_(world_axes)))
    sensed = [look(state) for state in states]
    assert sensed[0].size == number_of_senses(3, 3)
    same = np.allclose(*sensed, atol=1e-5)
    assert same != world_axes
    # ahead in its own axes is outwards in the world
    outward = to_world(jnp.array([1.0, 0.0, 0.0]), states[1], jnp.bool_(False))
    position = states[1].evader_position
    np.testing.assert_allclose(outward[:2], position[:2] / jnp.linalg.norm(position[:2]), atol=1e-5)


def test_more_slots_sense_pillars_that_are_not_there():
    state = state_of(jax.jit(lambda key: uniform_task(GAME.settings, key))(jax.random.key(0)))
    few = sense(GAME.settings, state, jnp.bool_(False))
    many = sense(GAME.settings, state, jnp.bool_(False), slots=5)
    np.testing.assert_array_equal(many[: few.size], few)
    blind = dataclasses.replace(state.task, pillar_active=jnp.zeros(3, bool))
    absent = sense(GAME.settings, state.replace(task=blind), jnp.bool_(False))
    np.testing.assert_array_equal(many[few.size :], absent[-8:])


def test_a_specialist_learns_on_a_layout_of_its_own():
    """Of two layouts without and with a pillar, two of four learners have one each."""
    learning = BestResponseSettings(learners=4, specialists=2, layouts=0.0)
    tasks = jax.vmap(lambda key: uniform_task(GAME.settings, key))(jax.random.split(KEY, 2))
    layouts = tasks.replace(pillar_active=jnp.array([[True, False, True], [False, True, False]]))
    draw = functools.partial(draw_own_task, GAME.settings, layouts, learning)
    keys = jax.random.split(KEY, 4 * 64)
    drawn = jax.jit(jax.vmap(draw))(keys, jnp.repeat(jnp.arange(4), 64)).pillar_active
    drawn = drawn.reshape(4, 64, 3)
    share = [(drawn == active).all(-1).mean(1) for active in layouts.pillar_active]
    np.testing.assert_allclose(share, [[0, 0, 0.75, 0], [0, 0, 0, 0.75]], atol=0.15)


def test_who_plans_gets_away_from_slower_points_in_the_open():
    """One that hovers is caught by points that fly straight at it; one that plans
    isn't.
    """
    game = game_of_points(
        arena_radius=10.0, arena_height=10.0, max_speed=1.0, evader_speed=1.3, episode_length=80
    )
    duel = Duel(game, Team(straight))
    task = jax.jit(lambda key: uniform_task(game.settings, key))(jax.random.key(3))
    middle = jnp.array([0.0, 0.0, 5.0])
    around = middle + 0.6 * jnp.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.0]])
    task = task.replace(
        evader_position=middle,
        pursuer_position=around,
        pillar_active=jnp.zeros_like(task.pillar_active),
    )
    world = jax.tree.map(lambda leaf: leaf[None], task)
    start = jax.jit(duel.start)(world, jax.random.key(4))
    still = jax.jit(lambda world: duel.fly({}, world, jnp.zeros((1, 3)), 80))(start)
    assert still[1].statistics.captured[0]
    planner = Planner(PlannerSettings(plans=24, piece_steps=10), duel)
    planned = jax.jit(planner.fly)({}, start, jax.random.key(5))
    assert not planned.captured[0]


def test_plans_end_by_the_evaders_own_rule_and_refined_ones_keep_their_speed():
    settings = PlannerSettings(plans=20, refined=0.5, own_rule=0.5)
    planner = Planner(settings, Duel(GAME, Team(straight)))
    last = jnp.broadcast_to(jnp.array([0.0, 0.6, 0.8]), (2, settings.pieces, 3))
    plans = np.asarray(jax.jit(planner.search.candidates)(jax.random.key(0), last))
    assert plans.shape == (2, 20, settings.pieces, 3)
    is_own = np.isnan(plans).all(-1)
    np.testing.assert_array_equal(is_own, np.isnan(plans).any(-1))
    np.testing.assert_array_equal(is_own, np.maximum.accumulate(is_own, axis=-1))
    assert is_own[:, :, 0].any(1).all()
    np.testing.assert_allclose(np.linalg.norm(plans[~is_own], axis=-1), 1.0, rtol=1e-5)
    # of the refined ones each is changed somewhere, and most not everywhere
    same = (np.abs(plans[:, -9:] - last[:, None]) < 1e-5).all(-1)
    assert not same.all(-1).any() and same.any()


def test_a_value_counts_at_the_end_of_a_plan_unless_it_was_caught():
    state = state_of(jax.jit(lambda key: uniform_task(GAME.settings, key))(jax.random.key(0)))
    statistics = state.statistics
    caught = dataclasses.replace(statistics, captured=jnp.bool_(True), capture_step=state.step + 3)
    duel = Duel(GAME, Team(straight))
    plain = Planner(PlannerSettings(), duel).search
    valued = Planner(PlannerSettings(), duel, value=lambda state: 9.0).search
    for end, free in ((state, 80 + 9), (state.replace(statistics=caught), 3)):
        room = plain.promise(state, end) - plain.free_steps(state, end)
        np.testing.assert_allclose(valued.promise(state, end) - room, free, atol=1e-4)


def test_of_several_ways_the_likeliest_is_flown():
    means = jnp.arange(6.0)
    odds = jnp.array([0.1, 0.7])
    np.testing.assert_array_equal(likeliest(jnp.concatenate([means, odds])), [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(likeliest(means[:3]), means[:3])
    spread_out, log_odds = ways(jnp.concatenate([means, odds]))
    assert spread_out.shape == (2, 3)
    np.testing.assert_allclose(jnp.sum(jnp.exp(log_odds)), 1.0, rtol=1e-6)
