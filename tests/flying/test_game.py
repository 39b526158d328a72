"""The game around measured vehicles: the packed tick plays as the game's own functions
do.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from openjax import load_policy
from openjax.flying.controller import Pose
from openjax.flying.game import Game, game_functions, pose_array
from openjax.flying.real_time import compile_in_line
from openjax.pursuit import find_scenario, scenario_task
from openjax.pursuit.teams import strategy_of


def test_the_packed_tick_plays_as_the_games_own_functions():
    policy = load_policy("no_clamp_seed_0")
    settings = policy.settings.environment
    scenario = find_scenario("wall", settings)
    slots = max(settings.max_pillars, len(scenario.pillars))
    task = scenario_task(dataclasses.replace(settings, max_pillars=slots), scenario)
    game = Game(policy, task)
    first, tick = (jax.jit(function) for function in game_functions(policy)[2:])

    offsets = np.array([[0.1, 0.0, 0.0], [-0.1, 0.1, 0.0], [0.0, -0.2, 0.1]])

    def poses(place):
        level = (1.0, 0.0, 0.0, 0.0)
        return [Pose(0.0, tuple(place + offset), (0.1, 0.2, 0.0), level) for offset in offsets]

    play = game.start(poses(np.array([0.0, 0.5, 0.6])))
    state, action = first(task, pose_array(poses(np.array([0.0, 0.5, 0.6]))))
    np.testing.assert_allclose(play.action, action, atol=1e-6)
    caught = False
    for step in range(1, 31):
        evader = np.array([0.1, 0.2, 0.5]) if step == 20 else None
        seen = poses(play.evader_position if step > 20 else 0.3 * play.evader_position)
        play = game.step(seen, evader)
        place = np.zeros(3, np.float32) if evader is None else evader.astype(np.float32)
        state, action, *rest = tick(state, action, pose_array(seen), place, evader is not None)
        for mine, expected in zip(play[:7], (action, *rest), strict=True):
            np.testing.assert_allclose(
                np.asarray(mine, float), np.asarray(expected, float), atol=1e-5
            )
        caught |= play.captured
    assert caught


def test_what_a_team_draws_is_told():
    """As the game's state has it; a policy that draws nothing tells nothing."""
    policy = load_policy("evaders")
    settings = policy.settings.environment
    assert settings.strategies > 1
    scenario = find_scenario("wall", settings)
    slots = max(settings.max_pillars, len(scenario.pillars))
    task = scenario_task(dataclasses.replace(settings, max_pillars=slots), scenario)
    game = Game(policy, task)
    poses = [Pose(0.0, (0.3 * i, 0.0, 0.5), (0.0,) * 3, (1.0, 0.0, 0.0, 0.0)) for i in range(3)]
    drawn = [game.start(poses).draws for _ in range(4)]
    assert len(drawn[0]) == -(-settings.episode_length // settings.strategy_steps)
    meant = strategy_of(settings, jnp.array(drawn), jnp.ones(np.shape(drawn), bool))
    assert len(set(drawn)) > 1 and set(np.unique(meant).tolist()) == set(range(settings.strategies))


def test_a_compiler_without_the_option_compiles_as_it_does():
    class Lowered:
        def compile(self, compiler_options=None):
            if compiler_options:
                raise RuntimeError(f"no such compile option: {next(iter(compiler_options))}")
            return "compiled"

    assert compile_in_line(Lowered()) == "compiled"
    double = compile_in_line(jax.jit(lambda x: 2 * x).lower(np.ones(3, np.float32)))
    np.testing.assert_array_equal(double(np.arange(3, dtype=np.float32)), [0.0, 2.0, 4.0])
