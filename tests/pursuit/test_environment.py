"""The environment as pure functions: compiled or not, mapped or not, any size; its end,
its gradients, its solids.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.pursuit import (
    SCENARIOS,
    Pursuit,
    PursuitSettings,
    Task,
    action_to_command,
    hover_action,
    make,
    scenario_task,
)
from openjax.pursuit.evaders import field_velocity
from openjax.pursuit.sensing import line_of_sight
from openjax.vehicle.effects import EFFECTS
from tests.vehicle.typical import typical

KEY = jax.random.key(0)
TINY = PursuitSettings(physics="rigid", episode_length=3)


@pytest.fixture(scope="module")
def tiny():
    return Pursuit(TINY)


@pytest.mark.slow
def test_compiled_and_mapped_is_the_same_as_eager_one_by_one(tiny):
    keys = jax.random.split(KEY, 3)
    actions = jax.random.uniform(KEY, (3, 3, 4), minval=-1.0)
    _, states = jax.jit(jax.vmap(tiny.reset))(keys)
    step = jax.jit(jax.vmap(chex.assert_max_traces(tiny.step, n=1)))
    together = step(keys, states, actions)
    step(
        keys, together[1], actions
    )  # what a step returns is what it takes: nothing is compiled again
    eager = tiny.step(keys[2], jax.tree.map(lambda x: x[2], states), actions[2])
    chex.assert_trees_all_close(jax.tree.map(lambda x: x[2], together), eager, atol=1e-4, rtol=1e-5)
    chex.assert_trees_all_equal(together, step(keys, states, actions))  # pure


def test_arrays_of_another_shape_are_refused_while_tracing(tiny):
    with pytest.raises(UserError, match=r"\(2, 4\), but 3 pursuers take \(3, 4\)"):
        jax.eval_shape(tiny.step, KEY, jax.eval_shape(tiny.reset, KEY)[1], jnp.zeros((2, 4)))
    task = scenario_task(TINY, SCENARIOS["wall"])
    with pytest.raises(AssertionError, match="shape"):
        jax.eval_shape(tiny.reset_to, KEY, task.replace(pursuer_position=jnp.zeros((4, 3))))


@pytest.mark.parametrize("observe_time", [True, False])
def test_the_end_is_terminal_where_the_time_is_observed(observe_time):
    environment = make(TINY, observe_time=observe_time)

    @jax.jit
    def play(key):
        def one(state, _):
            _, state, _, terminated, truncated, _ = environment.step(key, state, jnp.zeros((3, 4)))
            return state, (terminated, truncated)

        return jax.lax.scan(one, environment.reset(key)[1], length=4)[1]

    terminated, truncated = play(KEY)
    ends = [False, False, True, True]
    never = [False] * 4
    assert [terminated.tolist(), truncated.tolist()] == (
        [ends, never] if observe_time else [never, ends]
    )


@pytest.mark.parametrize(
    "changes",
    [
        dict(
            num_pursuers=1, observe_position=True, min_pillars=0, max_pillars=0, history_spacing=2
        ),
        dict(num_pursuers=8, max_pillars=2, min_pillars=0, speed_limit="none"),
        dict(
            arena_radius=2.0,
            arena_height=3.0,
            pillar_radius=0.05,
            capture_radius=0.1,
            substeps=2,
            time_step=0.02,
        ),
    ],
    ids=["one without pillars", "eight", "another arena"],
)
def test_other_sizes(changes):
    environment = make(TINY, **changes)
    settings = environment.settings

    @jax.jit
    def play(key):
        observation, state = environment.reset(key)
        action = jnp.broadcast_to(hover_action(environment.vehicle), (settings.num_pursuers, 4))
        return observation, *environment.step(key, state, action)

    first, second, state, reward, *_ = play(KEY)
    n = settings.num_pursuers
    assert first.self_state.shape == (n, settings.self_size)
    assert first.others.shape == (n, n - 1, 3)
    assert first.privileged.shape == (n, settings.privileged_size)
    assert first.pillars.shape == (n, settings.observed_pillars, 5)
    assert first.frames.shape == (settings.history_length, settings.frame_size)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), first) == jax.tree.map(
        lambda x: (x.shape, x.dtype), second
    )
    assert reward.shape == (n,) and np.isfinite(reward).all()
    moved = np.linalg.norm(state.evader_position - state.task.evader_position)
    np.testing.assert_allclose(moved, settings.evader_speed * settings.time_step, rtol=1e-2)


def test_commands():
    command = action_to_command(jnp.array([[-1.0, 1, -1, 0.5], [0.0, 0, 0, 0], [1.0, 3, 0, 0]]))
    expected = [[0, np.pi, -np.pi, np.pi / 2], [0.5, 0, 0, 0], [0.9, np.pi, 0, 0]]
    np.testing.assert_allclose(command, expected, atol=1e-6)


def test_order_within_a_step_and_history():
    """The evader flees where the pursuers were, frames are taken every
    `history_spacing` steps, oldest first.
    """
    environment = make(TINY, episode_length=100, history_length=3, history_spacing=2)

    @jax.jit
    def play(key):
        observation, state = environment.reset_to(
            key, scenario_task(environment.settings, SCENARIOS["hidden"])
        )

        def one(state, action):
            observation, new, *_ = environment.step(key, state, action)
            return new, (
                observation,
                new.evader_position,
                new.evader_velocity,
                new.drones.position,
                new.seen,
            )

        actions = jax.random.uniform(key, (9, 3, 4), minval=-1.0)
        return observation, state, jax.lax.scan(one, state, actions)[1]

    first, start, (observation, evader, velocity, position, seen) = jax.tree.map(
        np.asarray, play(KEY)
    )
    np.testing.assert_allclose(evader[0], start.evader_position + 0.01 * velocity[0], atol=1e-6)
    pillars = jax.tree.map(jnp.asarray, (start.task.pillar_position, start.task.pillar_active))

    @jax.jit
    @jax.vmap
    def fled(evader, position):
        in_sight = line_of_sight(environment.settings, position, evader, *pillars)
        return in_sight, field_velocity(environment.settings, evader, position, in_sight, *pillars)

    in_sight, expected = fled(
        np.concatenate([start.evader_position[None], evader[:-1]]),
        np.concatenate([start.drones.position[None], position[:-1]]),
    )
    np.testing.assert_allclose(velocity, expected, atol=1e-3)
    assert not in_sight[0].any() and not start.seen
    np.testing.assert_allclose(start.last_seen, [0, 0, 0.6])
    np.testing.assert_array_equal(first.frames[0], first.frames[2])
    # observation after step k + 1: frames of steps k - 3, k - 1, k + 1
    for k in (2, 8):
        for slot, step in enumerate((k - 3, k - 1, k + 1)):
            frame = observation.frames[k, slot]
            if step <= 0:
                np.testing.assert_array_equal(frame, first.frames[0])
                continue
            at = step - 1
            shown = np.r_[evader[at], velocity[at]] if seen[at] else np.full(6, -5.0)
            np.testing.assert_allclose(
                frame, np.r_[step / 100, shown, position[at].ravel()], atol=1e-6
            )


def test_clamp_cuts_the_norm_of_the_velocity():
    fast = jnp.array([[3.0, 4, 0], [0.3, 0.4, 0], [0, 0, 1.005]])

    @jax.jit
    def step(key):
        speeds = []
        for limit in ("clamp", "none"):
            environment = make(TINY, speed_limit=limit, start_attitude="level")
            _, state = environment.reset(key)
            state = state.replace(drones=state.drones.replace(velocity=fast))
            action = jnp.broadcast_to(hover_action(environment.vehicle), (3, 4))
            speeds.append(environment.step(key, state, action)[1].drones.velocity)
        return speeds

    clamped, free = step(KEY)
    np.testing.assert_allclose(free, fast, atol=1e-3)
    np.testing.assert_allclose(clamped, [[0.6, 0.8, 0], [0.3, 0.4, 0], [0, 0, 1]], atol=1e-3)


@pytest.mark.slow
def test_gradients_of_free_flight_are_finite_and_right(tiny):
    """Of the distance to the evader after some steps, by the actions; checked along one
    direction.
    """

    def loss(actions, state):
        def one(state, action):
            _, state, reward, *_ = tiny.step(KEY, state, action)
            return state, reward

        state, reward = jax.lax.scan(one, state, actions)
        return jnp.sum(
            jnp.linalg.norm(state.drones.position - state.evader_position, axis=-1)
        ) - 0.01 * jnp.sum(reward)

    actions = 0.5 * jax.random.uniform(KEY, (8, 3, 4), minval=-1.0)
    with jax.enable_x64(False):
        _, state = jax.jit(tiny.reset)(jax.random.key(3))
        value_and_gradient = jax.jit(jax.value_and_grad(loss))
        _, gradient = value_and_gradient(actions, state)
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 1e-5
        direction = gradient / jnp.linalg.norm(gradient)
        step = 1e-2
        up, _ = value_and_gradient(actions + step * direction, state)
        down, _ = value_and_gradient(actions - step * direction, state)
    np.testing.assert_allclose((up - down) / (2 * step), jnp.sum(gradient * direction), rtol=0.05)


def test_pillar_and_floor_are_solid():
    """One drone flies into a pillar, one falls to the floor, one flies into another
    drone: all stay outside.
    """
    settings = PursuitSettings(
        num_pursuers=4,
        max_pillars=1,
        min_pillars=0,
        start_attitude="level",
        episode_length=60,
        evader_speed=0.01,
    )
    environment = Pursuit(settings)
    task = Task(
        pursuer_position=jnp.array(
            [[0.3, 0.0, 0.6], [0.0, -0.6, 0.3], [-0.5, 0.4, 0.6], [-0.5, 0.65, 0.6]]
        ),
        evader_position=jnp.array([-0.7, -0.2, 0.6]),
        pillar_position=jnp.zeros((1, 2)),
        pillar_active=jnp.ones(1, bool),
    )
    speed = jnp.array([[-1.0, 0, 0], [0, 0, 0], [0, 0.8, 0], [0, -0.8, 0]])

    @jax.jit
    def play():
        _, state = environment.reset_to(KEY, task)
        state = state.replace(drones=state.drones.replace(velocity=speed))
        hover = hover_action(environment.vehicle)
        actions = jnp.stack([hover, jnp.array([-1.0, 0, 0, 0]), hover, hover])

        def one(state, _):
            _, state, _, _, _, info = environment.step(KEY, state, actions)
            return state, (state.drones.position, info.crashed)

        state, (position, crash) = jax.lax.scan(one, state, length=60)
        return position, crash, state.statistics

    position, crash, statistics = jax.tree.map(np.asarray, play())
    to_axis = np.linalg.norm(position[:, 0, :2], axis=-1)
    between = np.linalg.norm(position[:, 2] - position[:, 3], axis=-1)
    reached = [to_axis.min(), position[:, 1, 2].min(), between.min()]
    np.testing.assert_allclose(reached, [0.15, 0.05, 0.1], atol=0.01)
    assert crash.any(axis=0).all() and statistics.crashed
    assert statistics.pillar_steps > 0 and statistics.drone_steps > 0


def test_physical_effects_act_in_the_game():
    """Drag slows, a late sensor shows the past, random packet loss differs from episode
    to episode.
    """
    names = ("rotor_drag", "state_latency", "packet_loss")
    parameters = {name: typical(EFFECTS[name]) for name in names}
    environment = Pursuit(TINY, effects=names, effect_parameters=parameters)

    @jax.jit
    def step(key):
        first, state = environment.reset(key)
        state = state.replace(drones=state.drones.replace(velocity=jnp.ones((3, 3)) * 0.4))
        action = jnp.broadcast_to(hover_action(environment.vehicle), (3, 4))
        observation, state, *_ = environment.step(key, state, action)
        return first, observation, state

    first, observation, state = step(KEY)
    assert (np.linalg.norm(state.drones.velocity, axis=-1) < 0.4 * 3**0.5).any()
    moved = np.abs(np.asarray(observation.position - state.drones.position)).max()
    np.testing.assert_array_less(1e-4, moved)
    np.testing.assert_allclose(first.position, state.task.pursuer_position, atol=1e-6)


@pytest.mark.parametrize(
    ("physics", "effects"), [("mjx", ()), ("rigid", ()), ("stops", ()), ("rigid", ("rotor_drag",))]
)
def test_pillars_are_as_wide_and_as_high_as_the_settings_say(physics, effects):
    """Thrown at a pillar of 0.3 m and over one that ends below: stopped at the surface,
    and not stopped.
    """
    settings = PursuitSettings(
        num_pursuers=2,
        min_pillars=0,
        max_pillars=1,
        pillar_radius=0.3,
        arena_height=1.0,
        physics=physics,
        speed_limit="none",
        start_attitude="level",
    )
    task = Task(
        pursuer_position=jnp.array([[-0.6, 0.0, 0.5], [0.6, 0.0, 1.6]]),
        evader_position=jnp.array([0.0, 0.8, 0.5]),
        pillar_position=jnp.zeros((1, 2)),
        pillar_active=jnp.ones(1, bool),
    )

    def fly(state, _):
        action = jnp.broadcast_to(hover_action(environment.vehicle), (2, 4))
        _, state, *_ = environment.step(KEY, state, action)
        return state, state.drones.position

    environment = Pursuit(settings, effects=effects)

    @jax.jit
    def throw(task):
        _, state = environment.reset_to(KEY, task)
        velocity = jnp.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
        state = state.replace(drones=state.drones.replace(velocity=velocity))
        return jax.lax.scan(fly, state, None, length=50)[1]

    position = throw(task)
    distance = np.linalg.norm(position[:, 0, :2], axis=-1)
    # stops puts a drone back at a step's end
    sunk = 0.021 if physics == "stops" else 0.002
    assert 0.35 - sunk < distance.min() < 0.36
    # the "stops" pillars have no end; elsewhere the second flies over the rounded top
    assert physics == "stops" or position[-1, 1, 0] < -0.2
