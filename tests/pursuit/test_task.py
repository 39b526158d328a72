"""Drawn tasks: where they start, what expansion and turning keep, and attitudes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import (
    PursuitSettings,
    Task,
    close_starts,
    expand_task,
    line_up_pillars,
    scatter_starts,
    shift_pillars,
    turn_task,
    uniform_task,
)
from openjax.pursuit.task import start_attitude, starts_clear

SETTINGS = PursuitSettings()
DRAWS = 2000


def keys(seed, number=DRAWS):
    return jax.random.split(jax.random.key(seed), number)


@pytest.fixture(scope="module")
def uniform():
    return jax.jit(jax.vmap(lambda key: uniform_task(SETTINGS, key)))(keys(0))


@pytest.fixture(scope="module")
def expand():
    return jax.jit(jax.vmap(lambda key, task: expand_task(SETTINGS, key, task)))


def distances(tasks):
    """Between pursuers, from pursuers and from the evader to the surface of the nearest
    pillar; (B, ...) each.
    """
    pursuers, evader, pillars = (
        np.asarray(x, np.float64)
        for x in (tasks.pursuer_position, tasks.evader_position, tasks.pillar_position)
    )
    n = pursuers.shape[1]
    between = np.linalg.norm(pursuers[:, :, None] - pursuers[:, None], axis=-1)[
        :, ~np.eye(n, dtype=bool)
    ]

    def to_pillars(points):
        distance = np.linalg.norm(points[:, :, None, :2] - pillars[:, None], axis=-1) - 0.1
        return np.where(np.asarray(tasks.pillar_active)[:, None], distance, np.inf)

    return between, to_pillars(pursuers), to_pillars(evader[:, None])


def assert_clear(tasks, slack=1e-6):
    between, pursuers, evader = distances(tasks)
    assert between.min() >= 0.14 - slack
    assert pursuers.min() >= 0.07 - slack
    assert evader.min() > 0.0
    assert np.linalg.norm(tasks.pursuer_position[..., :2], axis=-1).max() <= 0.9 + slack


def test_uniform_tasks_start_in_their_box_and_clear(uniform):
    assert_clear(uniform)
    pursuers = np.asarray(uniform.pursuer_position)
    evader = np.asarray(uniform.evader_position)
    mirrored = evader * [-1, 1, 1]
    for positions in (pursuers.reshape(-1, 3), mirrored):
        low = positions.min(axis=0)
        high = positions.max(axis=0)
        assert (low >= [0.1, -0.536, 0.5]).all() and (high <= np.float32([0.536, 0.536, 0.7])).all()
        np.testing.assert_allclose(low, [0.1, -0.536, 0.5], atol=0.02)  # and fill it
        np.testing.assert_allclose(high, [0.536, 0.536, 0.7], atol=0.02)


def test_pillars_of_uniform_tasks(uniform):
    pillars = np.asarray(uniform.pillar_position)
    active = np.asarray(uniform.pillar_active)
    number = active.sum(axis=1)
    assert set(number) == {4, 5} and 0.4 < np.mean(number == 5) < 0.6
    cells = np.round(pillars / 0.2).astype(int)
    np.testing.assert_allclose(pillars, 0.2 * cells, atol=1e-6)
    assert (np.linalg.norm(pillars[active], axis=-1) < 0.8).all()
    for cell, used in zip(cells[:500], active[:500], strict=True):
        assert len({tuple(c) for c in cell[used]}) == used.sum()
    starts = np.concatenate([uniform.pursuer_position, uniform.evader_position[:, None]], axis=1)[
        ..., :2
    ]
    same_cell = (np.round(starts / 0.2)[:, :, None] == cells[:, None]).all(axis=-1) & active[
        :, None
    ]
    assert not same_cell.any()


def test_eight_pursuers_start_clear():
    settings = PursuitSettings(num_pursuers=8)
    tasks = jax.jit(jax.vmap(lambda key: uniform_task(settings, key)))(keys(1, 500))
    assert tasks.pursuer_position.shape == (500, 8, 3)
    clear = jax.jit(jax.vmap(lambda task: starts_clear(settings, task)))(tasks)
    assert clear.all()


def test_expansion_moves_vehicles_a_little_and_never_into_a_breach(uniform, expand):
    tasks = uniform
    for generation in range(4):  # out of the box of the uniform draw
        parents = tasks
        tasks = expand(keys(10 + generation), tasks)
        for name in ("pillar_position", "pillar_active"):
            np.testing.assert_array_equal(getattr(tasks, name), getattr(uniform, name))
        for name in ("pursuer_position", "evader_position"):
            moved = np.asarray(getattr(tasks, name)) - np.asarray(getattr(parents, name))
            # the push back from the rim may turn a move along the axes into an oblique
            # one
            assert np.linalg.norm(moved[..., :2], axis=-1).max() <= 0.1 * 2**0.5 + 1e-6
            assert np.abs(moved[..., 2]).max() <= 0.1 + 1e-6
        assert_clear(tasks)
    positions = np.concatenate([tasks.pursuer_position, tasks.evader_position[:, None]], axis=1)
    assert np.linalg.norm(positions[..., :2], axis=-1).max() <= 0.8 + 1e-6
    assert positions[..., 2].min() >= 0.5 - 1e-6 and positions[..., 2].max() <= 0.7 + 1e-6
    assert positions[:, :3, 0].min() < 0.0
    assert (
        np.mean(
            np.any(
                np.asarray(tasks.evader_position) != np.asarray(parents.evader_position), axis=-1
            )
        )
        > 0.95
    )


def test_expansion_of_a_task_without_room_is_the_task_itself(uniform):
    # each pursuer is ringed by six pillars that only just leave it room
    turn = 2 * np.pi / 3 * np.arange(3)
    pursuers = 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    ring = np.pi / 3 * np.arange(6)
    pillars = pursuers[:, None] + 0.1705 * np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    task = Task(
        pursuer_position=jnp.asarray(np.c_[pursuers, np.full(3, 0.6)], jnp.float32),
        evader_position=jnp.array([0.0, 0.0, 0.6]),
        pillar_position=jnp.asarray(pillars.reshape(18, 2), jnp.float32),
        pillar_active=jnp.ones(18, bool),
    )
    assert starts_clear(SETTINGS, task)
    drawn = jax.jit(jax.vmap(lambda key: expand_task(SETTINGS, key, task)))(keys(20, 100))
    for name in ("pursuer_position", "evader_position"):
        np.testing.assert_array_equal(
            getattr(drawn, name),
            np.tile(getattr(task, name), (100, 1, 1)).reshape(getattr(drawn, name).shape),
        )


def test_turning_keeps_all_distances(uniform):
    turned = jax.jit(jax.vmap(turn_task))(keys(30), uniform)
    for before, after in zip(distances(uniform), distances(turned), strict=True):
        finite = np.isfinite(before)
        np.testing.assert_array_equal(np.isfinite(after), finite)
        np.testing.assert_allclose(after[finite], before[finite], atol=1e-5)
    np.testing.assert_array_equal(turned.pursuer_position[..., 2], uniform.pursuer_position[..., 2])
    angle = np.arctan2(turned.evader_position[:, 1], turned.evader_position[:, 0])
    # from all sides
    assert np.histogram(angle, 8, (-np.pi, np.pi))[0].min() > DRAWS / 16


def test_shifted_pillars_leave_the_grid_and_keep_clear_of_starts(uniform):
    shift = jax.jit(jax.vmap(lambda key, task: shift_pillars(SETTINGS, key, task, 0.1)))
    shifted = shift(keys(31), uniform)
    assert_clear(shifted)
    moved = np.asarray(shifted.pillar_position - uniform.pillar_position)[
        np.asarray(uniform.pillar_active)
    ]
    assert 0.099 < np.abs(moved).max() <= 0.1 + 1e-6
    stayed = (moved == 0.0).all(axis=-1)
    assert 0.0 < stayed.mean() < 0.2  # those that would have come too close
    np.testing.assert_allclose(moved[~stayed].mean(axis=0), 0.0, atol=0.005)
    assert np.linalg.norm(shifted.pillar_position, axis=-1).max() < 0.8
    np.testing.assert_array_equal(shifted.pursuer_position, uniform.pursuer_position)


def test_pillars_in_a_row_stand_between_the_sides(uniform):
    lined = jax.jit(jax.vmap(lambda key, task: line_up_pillars(SETTINGS, key, task)))(
        keys(32), uniform
    )
    assert_clear(lined)
    active = np.asarray(lined.pillar_active)
    np.testing.assert_array_equal(active, uniform.pillar_active)
    whole = (
        np.asarray(lined.pillar_position != uniform.pillar_position).any(axis=-1) | ~active
    ).all(axis=-1)
    assert whole.mean() > 0.1  # rows of which no pillar had to stay
    for pillars, used in zip(
        np.asarray(lined.pillar_position, np.float64)[whole], active[whole], strict=True
    ):
        step = np.diff(pillars[used], axis=0)
        spacing = np.linalg.norm(step, axis=-1)
        np.testing.assert_allclose(spacing, spacing[0], atol=1e-5)
        assert 0.2 - 1e-5 <= spacing[0] <= 0.4 + 1e-5
        np.testing.assert_allclose(step, np.broadcast_to(step[0], step.shape), atol=1e-5)
        assert (
            np.abs(step[0, 0]) <= step[0, 1] + 1e-5
        )  # across the line between the sides, within 45 degrees
        assert np.abs(pillars[used].mean(axis=0)).max() <= 0.2 + 1e-5


def test_close_starts_leave_little_room_beside_a_pillar_or_another_pursuer(uniform):
    move = jax.jit(jax.vmap(functools.partial(close_starts, SETTINGS), (0, 0, None)))
    close = move(keys(33), uniform, 0.5)
    assert_clear(close)
    assert np.abs(close.pursuer_position[..., 2] - 0.6).max() <= 0.1 + 1e-6
    for name in ("evader_position", "pillar_position", "pillar_active"):
        np.testing.assert_array_equal(getattr(close, name), getattr(uniform, name))
    moved = np.asarray(close.pursuer_position != uniform.pursuer_position).any(axis=-1)
    # fewer where there is no room
    np.testing.assert_allclose(moved.mean(), 0.5, atol=0.1)
    between, pillars, _ = distances(close)
    to_pursuer = between.reshape(DRAWS, 3, 2).min(axis=-1) < 0.14 + 0.05 + 1e-5
    to_pillar = pillars.min(axis=-1) < 0.07 + 0.05 + 1e-5
    assert (to_pursuer | to_pillar)[moved].all()
    assert to_pursuer[moved].mean() > 0.35 and to_pillar[moved].mean() > 0.5
    # without pillars there's nothing to be put beside for the first
    alone = uniform.replace(pillar_active=np.zeros_like(uniform.pillar_active))
    close = move(keys(34), alone, 1.0)
    assert_clear(close)
    moved = np.asarray(close.pursuer_position != uniform.pursuer_position).any(axis=-1)
    assert not moved[:, 0].any() and moved[:, 1:].mean() > 0.9
    assert (distances(close)[0].reshape(DRAWS, 3, 2).min(axis=-1) < 0.14 + 0.05 + 1e-5)[moved].all()


def test_scattered_starts_fill_the_arena_and_are_clear(uniform):
    scattered = jax.jit(jax.vmap(lambda key, task: scatter_starts(SETTINGS, key, task)))(
        keys(35), uniform
    )
    assert_clear(scattered)
    pursuers = np.asarray(scattered.pursuer_position)
    evader = np.asarray(scattered.evader_position)
    for points in (pursuers.reshape(-1, 3), evader):
        radius = np.linalg.norm(points[:, :2], axis=-1)
        assert 0.75 < radius.max() <= 0.8 + 1e-6 and radius.min() < 0.1
        assert np.abs(points[:, 2] - 0.6).max() <= 0.1 + 1e-6
    # all of the arena's sides, and from beside each other to farther apart than any
    # uniform task
    assert np.abs(evader[:, :2].mean(axis=0)).max() < 0.05
    apart = np.linalg.norm(pursuers - evader[:, None], axis=-1)
    assert apart.min() < 0.3 and apart.max() > 1.5
    changed = np.any(pursuers != np.asarray(uniform.pursuer_position), axis=(1, 2))
    assert changed.mean() > 0.9


def test_start_attitudes():
    from scipy.spatial.transform import Rotation

    quaternion = np.asarray(
        jax.jit(jax.vmap(lambda key: start_attitude(SETTINGS, key)))(keys(40))
    ).reshape(-1, 4)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1.0, atol=1e-5)
    yaw, pitch, roll = (
        Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_euler("ZYX", degrees=True).T
    )
    for angle, low in ((roll, -36), (pitch, -36), (yaw, 0)):
        np.testing.assert_allclose([angle.min(), angle.max()], [low, 36], atol=0.5)
        assert angle.min() >= low - 1e-3 and angle.max() <= 36 + 1e-3
    level = start_attitude(PursuitSettings(start_attitude="level"), jax.random.key(0))
    np.testing.assert_array_equal(level, [[1, 0, 0, 0]] * 3)
