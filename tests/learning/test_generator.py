"""The adaptive environment generator: which tasks it draws and which it keeps."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.learning.archive import empty_archive
from openjax.learning.generator import (
    generate_task,
    select,
    successes,
    task_like,
    vary_pillars,
)
from openjax.learning.settings import GeneratorSettings
from openjax.pursuit import Pursuit, PursuitSettings, Task, empty_task, uniform_task
from openjax.pursuit.statistics import empty_statistics

GAME = PursuitSettings()
NOMINAL = GeneratorSettings(capacity=8)
KEYS = jax.random.split(jax.random.key(0), 1000)


@functools.cache
def generate(settings):
    return jax.jit(
        jax.vmap(lambda archive, key: generate_task(settings, GAME, archive, key), (None, 0))
    )


def generated(settings, archive):
    return generate(settings)(archive, KEYS)


def gaps(tasks):
    """(T, N) m on the level between pursuers, who start beyond .1 m on one side, and the
    evader, which does on the other.
    """
    away = tasks.pursuer_position - tasks.evader_position[:, None]
    return np.linalg.norm(np.asarray(away)[..., :2], axis=-1)


def archived():
    """An archive of one task that no uniform draw can give: pillars off the grid, all
    on the other side.
    """
    archive = empty_archive(empty_task(GAME), 8)
    task = Task(
        pursuer_position=jnp.array([[-0.5, 0, 0.6], [-0.5, 0.3, 0.6], [-0.5, -0.3, 0.6]]),
        evader_position=jnp.array([0.5, 0.0, 0.6]),
        pillar_position=jnp.array([[0.05, 0.05]] + [[0.0, 0.0]] * 4),
        pillar_active=jnp.array([True] + [False] * 4),
    )
    tasks = jax.tree.map(lambda slots, one: slots.at[0].set(one), archive.tasks, task)
    return archive.replace(tasks=tasks, size=jnp.int32(1)), task


@pytest.mark.parametrize("switch", ["empty archive", "disabled"])
def test_uniform_tasks_without_archived_ones(switch):
    if switch == "empty archive":
        tasks = generated(NOMINAL, empty_archive(empty_task(GAME), 8))
    else:
        tasks = generated(dataclasses.replace(NOMINAL, enabled=False), archived()[0])
    assert gaps(tasks).min() >= 0.2
    assert set(np.asarray(tasks.pillar_active.sum(axis=1))) == {4, 5}


def test_archived_tasks_are_expanded_with_probability_p():
    archive, parent = archived()
    tasks = generated(NOMINAL, archive)
    local = np.asarray(tasks.pillar_active.sum(axis=1)) == 1
    np.testing.assert_allclose(local.mean(), NOMINAL.expansion, atol=0.05)
    moved = np.asarray(tasks.pursuer_position)[local] - np.asarray(parent.pursuer_position)
    assert np.abs(moved).max() <= 0.1 + 1e-6 and np.abs(moved).max(axis=(1, 2)).min() > 0
    np.testing.assert_array_equal(np.asarray(tasks.pillar_position)[local][:, 0], np.float32(0.05))
    assert gaps(tasks)[~local].min() >= 0.2


def test_a_task_keeps_its_evader():
    game = PursuitSettings(evaders=("field", "greedy", "frozen"))
    archive = empty_archive(task_like(game), 8)
    of_two = archive.tasks.replace(evader=archive.tasks.evader.at[0].set(2))
    archive = archive.replace(tasks=of_two, size=jnp.int32(1))
    for expansion, expected in ((0.0, {0, 1, 2}), (1.0, {2})):
        how = dataclasses.replace(NOMINAL, expansion=expansion)
        generate = jax.jit(jax.vmap(lambda key, how=how: generate_task(how, game, archive, key)))
        tasks = generate(KEYS[:64])
        assert set(np.asarray(tasks.evader)) == expected
    states = jax.jit(jax.vmap(Pursuit(game).reset_to))(KEYS[:64], tasks)[1]
    np.testing.assert_array_equal(states.evader.kind, 2)


def test_turned_uniform_tasks_come_from_all_sides():
    tasks = generated(NOMINAL, empty_archive(empty_task(GAME), 8))
    angle = np.arctan2(tasks.evader_position[:, 1], tasks.evader_position[:, 0])
    assert np.histogram(angle, 4, (-np.pi, np.pi))[0].min() > 150


def test_a_share_of_uniform_tasks_has_its_pillars_in_a_row():
    rows = dataclasses.replace(NOMINAL, row_share=0.25)
    plain = generated(NOMINAL, empty_archive(empty_task(GAME), 8))
    varied = generated(rows, empty_archive(empty_task(GAME), 8))
    np.testing.assert_array_equal(varied.pursuer_position, plain.pursuer_position)
    moved = np.abs(np.asarray(varied.pillar_position - plain.pillar_position))
    changed = (moved > 1e-4).any(axis=(1, 2))
    np.testing.assert_allclose(changed.mean(), 0.25, atol=0.05)


def test_pillars_of_uniform_tasks_are_moved_off_the_grid():
    on_grid = jax.jit(jax.vmap(functools.partial(uniform_task, GAME)))(KEYS)
    shifted = jax.jit(jax.vmap(functools.partial(vary_pillars, NOMINAL, GAME)))(KEYS, on_grid)
    moved = np.asarray(shifted.pillar_position - on_grid.pillar_position)
    assert 0.08 < np.abs(moved).max() <= NOMINAL.PILLAR_SHIFT + 1e-6


def test_unsolved_tasks_of_whole_episodes_enter():
    success = jnp.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.0, 0.75])
    complete = jnp.array([True] * 6 + [False])
    tasks = jax.tree.map(lambda x: jnp.stack([x] * 7), archived()[1])
    tasks = tasks.replace(evader_position=0.1 * jnp.arange(21.0).reshape(7, 3))
    archive = jax.jit(lambda *a: select(NOMINAL, *a))(
        empty_archive(empty_task(GAME), 8), tasks, success, complete
    )
    assert int(archive.size) == 3
    np.testing.assert_allclose(archive.success[:3], [0.9, 0.75, 0.5], atol=1e-6)
    np.testing.assert_array_equal(archive.tasks.evader_position[:3], tasks.evader_position[4:1:-1])


def test_collisions_may_spoil_a_success():
    statistics = jax.vmap(lambda _: empty_statistics(10))(jnp.arange(3)).replace(
        captured=jnp.array([True, True, False]),
        steps=jnp.full(3, 10),
        collision_steps=jnp.array([0.0, 2.0, 0.0]),
    )
    assert successes(NOMINAL, statistics).tolist() == [True, True, False]
    strict = dataclasses.replace(NOMINAL, collision_tolerance=0.1)
    assert successes(strict, statistics).tolist() == [True, False, False]
    # while a tenth of the penalties counts, up to 0.1 ** 0.1 = 0.79 is tolerated
    assert successes(strict, statistics, jnp.float32(0.1)).tolist() == [True, True, False]
