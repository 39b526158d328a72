"""Where an evader that nobody sees is taken to be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from openjax.pursuit import Pursuit, PursuitSettings, hover_action, uniform_task
from openjax.pursuit.hiding import STRIDES, nearest_hidden
from openjax.pursuit.sensing import line_of_sight
from openjax.vehicle import hover_state, load_vehicle

GAME = PursuitSettings(num_pursuers=2, max_pillars=1, min_pillars=1)
TASK = dataclasses.replace(
    uniform_task(GAME, jax.random.key(0)),
    pillar_position=jnp.zeros((1, 2)),
    pillar_active=jnp.ones(1, bool),
)
VEHICLE = load_vehicle()
TEAM = jnp.array([[-0.6, 0.1, 0.5], [-0.6, -0.1, 0.5]])


def tracked(thought, task=TASK, team=TEAM):
    """Where an evader is taken to be that was thought to be at (3,)."""
    drones = jax.vmap(hover_state, in_axes=(None, 0))(VEHICLE, team)
    return np.asarray(nearest_hidden(GAME, task, drones, None, jnp.array(thought)))


def test_a_hidden_place_is_kept_and_one_in_view_is_left_for_the_nearest_hidden_one():
    behind = [0.15, 0.0, 0.4]
    np.testing.assert_allclose(tracked(behind), behind)
    found = tracked([0.0, 0.2, 0.4])  # beside the pillar, in view
    pillars = TASK.pillar_position, TASK.pillar_active
    assert not line_of_sight(GAME, TEAM, jnp.array(found), *pillars).any()
    assert found[2] == np.float32(0.4)
    assert np.linalg.norm(found[:2] - [0.0, 0.2]) <= STRIDES[-1]


def test_where_nothing_near_is_hidden_it_stays():
    far = [-0.5, 0.5, 0.4]
    np.testing.assert_allclose(tracked(far), far)
    nothing = dataclasses.replace(TASK, pillar_active=jnp.zeros(1, bool))
    np.testing.assert_allclose(tracked([0.0, 0.2, 0.4], nothing), [0.0, 0.2, 0.4])


def test_a_game_tracks_only_whom_it_has_seen_and_nobody_sees():
    """Behind the pillar it is first unknown; seen once, it is followed behind it."""
    settings = dataclasses.replace(GAME, track_unseen=True, evaders=("frozen",))
    game = Pursuit(settings)
    task = TASK.with_starts(TEAM)
    step = jax.jit(game.step)
    action = jnp.broadcast_to(hover_action(game.vehicle), (2, 4))

    def last_seen(evader, before):
        start = dataclasses.replace(task, evader_position=jnp.array([0.15, 0.0, 0.4]))
        state = game.reset_to(jax.random.key(1), start)[1]
        state = state.replace(last_seen=jnp.array(before), evader_position=evader)
        return np.asarray(step(None, state, action)[1].last_seen)

    hidden = jnp.array([0.15, 0.0, 0.4])
    np.testing.assert_allclose(last_seen(hidden, settings.middle), settings.middle)
    assert np.abs(last_seen(hidden, [0.0, 0.2, 0.4])[1]) < 0.15
    seen = jnp.array([-0.2, 0.3, 0.4])
    np.testing.assert_allclose(last_seen(seen, [0.0, 0.2, 0.4]), seen, atol=0.02)
