"""Parts of one's own in the game: evaders, reward terms, observations."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax import Pursuit, PursuitSettings, UserError, make
from openjax.pursuit import RewardSettings, Term, default_reward, observe
from openjax.pursuit.evaders import EvaderKind

GAME = PursuitSettings(physics="stops", start_attitude="level", num_pursuers=2)


@functools.cache
def compiled(game):
    """Reset and step, compiled once for each game."""
    return jax.jit(game.reset), jax.jit(game.step)


def stepped(game, steps=3, wish=None, key=0):
    """The states, last observation and rewards (T, N) of some steps."""
    reset, step = compiled(game)
    observation, state = reset(jax.random.key(key))
    states = [state]
    rewards = []
    for _ in range(steps):
        action = jnp.zeros((2, 4))
        observation, state, reward, *_ = step(jax.random.key(0), state, action, wish)
        states.append(state)
        rewards.append(reward)
    return states, observation, np.stack(rewards)


def test_a_wish_that_is_not_a_number_is_the_papers_evaders_own_rule():
    game = Pursuit(GAME)
    free, _, _ = stepped(game)
    told, _, _ = stepped(game, wish=jnp.full(3, jnp.nan))
    np.testing.assert_array_equal(told[-1].evader_position, free[-1].evader_position)
    up, _, _ = stepped(game, wish=jnp.array([0.0, 0.0, 0.5]))
    wanted = [0.0, 0.0, 0.5 * GAME.evader_speed]
    np.testing.assert_allclose(up[1].evader_velocity, wanted, atol=1e-5)


def test_an_evader_of_ones_own_knows_motions_and_draws():
    """It flies as the first pursuer moves, plus noise, and remembers the noise in a
    fifth number.
    """

    def shadow(scene, memory):
        noise = 0.1 * jax.random.uniform(scene.key, (3,))
        upright = scene.thrust_direction[0, 2]
        velocity = scene.pursuer_velocity[0] + noise
        return velocity, memory.at[4].set(noise[0]).at[5].set(upright)

    game = Pursuit(GAME, evaders=("frozen", EvaderKind(shadow, memory=6)))
    assert game.settings.evaders == ("frozen", "own")
    for key in range(8):
        states, _, _ = stepped(game, key=key)
        if states[0].evader.kind == 1:
            break
    noise = [float(state.evader.memory[4]) for state in states]
    assert noise[0] == 0.0 and len(set(noise)) == 4
    np.testing.assert_allclose(states[1].evader.memory[5], 1.0)
    expected = states[1].drones.velocity[0] + noise[2]
    np.testing.assert_allclose(states[2].evader_velocity[0], expected[0], atol=1e-5)
    # a shipped one beside it stays what it is, and names alone go with other settings
    other = dataclasses.replace(make(GAME, evader="frozen"), settings=GAME)
    assert other.settings.evaders == ("field",)


def test_an_evader_of_ones_own_stays_within_speed_and_arena():
    states, _, _ = stepped(make(GAME, evader=lambda scene, memory: (jnp.full(3, 99.0), memory)), 60)
    speeds = [float(jnp.linalg.norm(state.evader_velocity)) for state in states]
    assert max(speeds) <= GAME.evader_speed * 1.001
    assert all(0 < float(state.evader_position[2]) < GAME.arena_height for state in states)


def test_settings_alone_do_not_make_an_evader_of_ones_own():
    with pytest.raises(UserError, match="evader own: a name isn't enough"):
        make(GAME, evaders=("own",))


def test_reward_terms_add_up_and_penalties_are_told_apart():
    weights = RewardSettings(margin=0.5, first_crash=3.0, smoothness=1.5)
    game = dataclasses.replace(GAME, reward=weights)
    shipped = default_reward(weights)

    def height(transition):
        return transition.state.drones.position[:, 2]

    own = (*shipped, Term(height, 2.0), Term(height, -0.5, penalty=True))
    constant = (Term(lambda step: jnp.ones(()), 1.0),)
    games = [Pursuit(game, reward=terms) for terms in (None, own, constant, ())]

    @jax.jit  # one program: its physics is the same for all rewards, and compiled once
    def step(state):
        results = [game.step(None, state, jnp.zeros((2, 4))) for game in games]
        return results[0][1], jnp.stack([reward for _, _, reward, *_ in results])

    _, state = compiled(games[0])[0](jax.random.key(0))
    for _ in range(3):
        state, (before, after, alone, nothing) = step(state)
        heights = state.drones.position[:, 2]
        np.testing.assert_allclose(after, before + 1.5 * heights, rtol=1e-5)
        np.testing.assert_array_equal(alone, 1.0)
        assert not nothing.any()


def test_an_observation_of_ones_own():
    def with_height(settings, state, seen):
        shipped = observe(settings, state, seen)
        own = jnp.concatenate([shipped.self_state, seen.position[:, 2:]], axis=-1)
        return shipped.replace(self_state=own)

    states, observation, _ = stepped(Pursuit(GAME, observer=with_height))
    np.testing.assert_array_equal(observation.self_state[:, -1], states[-1].drones.position[:, 2])
    assert observation.self_state.shape[-1] == GAME.self_size + 1


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"reward": Term(len, 1.0)}, "reward: Term is no tuple"),
        ({"reward": (len,)}, "reward: len is no Term"),
        ({"evaders": len}, "evaders: len is no tuple"),
        ({"evaders": (3,)}, "evaders: int is no evader"),
    ],
)
def test_what_is_no_part_is_a_line(part, words):
    with pytest.raises(UserError, match=words):
        Pursuit(GAME, **part)


def test_a_part_that_is_wrong_inside_is_a_line_with_its_name():
    def of_seven(step):
        return jnp.zeros(7)

    def place_alone(scene, memory):
        return scene.position

    def misspelt(step):
        return step.state.drones.velocities[:, 0]

    for part, words in (
        ({"reward": (Term(of_seven, 1.0),)}, r"reward term of_seven gives shape \(7,\)"),
        (
            {"reward": (Term(misspelt, 1.0),)},
            r"term misspelt: DroneState has no velocities; did you mean velocity\?",
        ),
        ({"evaders": (place_alone,)}, r"evader place_alone gives arrays of shapes"),
    ):
        game = Pursuit(GAME, **part)
        _, state = jax.eval_shape(game.reset, jax.random.key(0))
        with pytest.raises(UserError, match=words):
            jax.eval_shape(game.step, jax.random.key(0), state, jnp.zeros((2, 4)))
