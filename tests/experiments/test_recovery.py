"""The starts from which the first moments of an episode are learnt."""

import dataclasses

import jax
import numpy as np

from experiments.recovery import SIDE_BY_SIDE, side_by_side
from openjax.pursuit import PursuitSettings, uniform_task
from openjax.pursuit.task import starts_clear

GAME = PursuitSettings(min_pillars=0, max_pillars=1)


def test_all_stand_side_by_side():
    keys = jax.random.split(jax.random.key(0), 64)
    before = jax.vmap(lambda key: uniform_task(GAME, key))(keys)
    tasks = jax.vmap(lambda key, task: side_by_side(GAME, key, task))(keys, before)
    position = np.asarray(tasks.pursuer_position)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 9 * np.eye(3)
    moved = (position != np.asarray(before.pursuer_position)).any((1, 2))
    assert moved.mean() > 0.5
    assert (apart[moved].min(2) < GAME.drone_clearance + SIDE_BY_SIDE + 1e-4).all()
    near = dataclasses.replace(
        GAME, drone_clearance=GAME.drone_clearance - 0.01
    )  # outside the arena counts, too
    clear = jax.vmap(
        lambda task: starts_clear(dataclasses.replace(near, arena_radius=9.0, arena_height=9.0), task)
    )
    assert np.asarray(clear(tasks))[moved].all()
