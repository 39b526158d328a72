"""ShortestPaths round pillars, against closed forms and against Dijkstra's algorithm on
a fine grid.
"""

import functools
import heapq
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.pursuit import (
    Pursuit,
    PursuitSettings,
    hover_action,
    line_up_pillars,
    make,
    uniform_task,
)
from openjax.pursuit.shortest_paths import (
    ROOM,
    TOLL,
    path_length,
    shortest_paths,
)

GAME = PursuitSettings(min_pillars=5)
REACH = GAME.pillar_radius + GAME.pillar_clearance + ROOM
CELL = 0.02


@jax.jit
def length(task, position, target):
    position = jnp.asarray(position)
    target = jnp.asarray(target)
    return path_length(GAME, task, shortest_paths(GAME, task), position, target)


def one_pillar():
    task = jax.jit(functools.partial(uniform_task, GAME))(jax.random.key(0))
    return task.replace(
        pillar_position=jnp.zeros_like(task.pillar_position), pillar_active=jnp.arange(5) < 1
    )


def test_round_one_pillar_it_is_two_tangents_and_an_arc():
    far = 0.6
    bent = math.acos(REACH / 0.6)
    tangent = math.sqrt(far**2 - REACH**2)
    way = length(one_pillar(), [[far, 0.0, 0.5], [far, far, 0.5]], [-far, 0.0, 0.5])
    assert way[0] == pytest.approx(2 * tangent + REACH * (math.pi - 2 * bent), rel=0.01)
    # nothing is between them
    assert way[1] == pytest.approx(math.hypot(2 * far, far), rel=1e-4)


def test_who_is_too_near_a_pillar_leaves_it():
    task = one_pillar()
    gradient = jax.jit(jax.grad(lambda p: length(task, p[None], [-0.6, 0.0, 0.5])[0]))
    assert (
        gradient(jnp.array([0.12, 0.01, 0.5]))[0] < 0.1
    )  # not through the pillar, as the straight line would have it
    assert length(task, [[0.12, 0.01, 0.5]], [-0.6, 0.0, 0.5])[0] < TOLL


def test_in_a_larger_arena_of_its_own_a_task_has_ways_round_pillars_farther_out():
    game = PursuitSettings(min_pillars=1, arena_radii=(1.3, 1.3))
    task = jax.jit(functools.partial(uniform_task, game))(jax.random.key(0))
    task = task.replace(
        pillar_position=jnp.zeros_like(task.pillar_position).at[0].set([1.0, 0.0]),
        pillar_active=jnp.arange(5) < 1,
    )
    paths = jax.jit(functools.partial(shortest_paths, game))(task)
    ends = jnp.array([[1.0, 0.25, 0.5], [1.0, -0.25, 0.5]])
    assert path_length(game, task, paths, ends[:1], ends[1])[0] < 1.0


def on_a_grid(task, source):
    """The lengths (m) of ways from a place to all cells; a step leads to any cell at
    most three away in x and y.
    """
    places = np.arange(-0.9, 0.9 + CELL / 2, CELL)
    x, y = np.meshgrid(places, places, indexing="ij")
    free = x**2 + y**2 < GAME.arena_radius**2
    for (a, b), active in zip(
        np.asarray(task.pillar_position), np.asarray(task.pillar_active), strict=True
    ):
        free &= ~active | ((x - a) ** 2 + (y - b) ** 2 >= REACH**2)
    steps = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if math.gcd(i, j) == 1]
    start = cell(source)
    best = {start: 0.0}
    queue = [(0.0, start)]
    while queue:
        way, (i, j) = heapq.heappop(queue)
        if way > best[i, j]:
            continue
        for di, dj in steps:
            there = i + di, j + dj
            inside = 0 <= there[0] < len(places) and 0 <= there[1] < len(places)
            longer = way + CELL * math.hypot(di, dj)
            if inside and free[there] and longer < best.get(there, math.inf):
                best[there] = longer
                heapq.heappush(queue, (longer, there))
    return best


def cell(place):
    return tuple(round((float(coordinate) + 0.9) / CELL) for coordinate in place[:2])


def test_round_rows_it_is_as_long_as_on_a_grid():
    keys = jax.random.split(jax.random.key(1), 6)
    tasks = jax.jit(jax.vmap(lambda key: line_up_pillars(GAME, key, uniform_task(GAME, key))))(keys)
    lengths = jax.vmap(length)(tasks, tasks.pursuer_position, tasks.evader_position)
    height = tasks.pursuer_position[..., 2] - tasks.evader_position[:, None, 2]
    differences = []
    for b, own in enumerate(np.sqrt(np.asarray(lengths**2 - height**2))):
        grid = on_a_grid(jax.tree.map(lambda leaf, b=b: leaf[b], tasks), tasks.evader_position[b])
        grids = [grid.get(cell(place), math.inf) for place in tasks.pursuer_position[b]]
        # some start nearer a pillar than ways keep: no cell of the grid is theirs
        differences += [
            mine - theirs for mine, theirs in zip(own, grids, strict=True) if math.isfinite(theirs)
        ]
    assert len(differences) > 12
    # polygons are longer ways than circles; a grid's cells stand aside of the places
    assert min(differences) > -1.5 * CELL
    assert np.median(differences) < 0.05


def test_worlds_know_their_paths_only_where_the_reward_asks_for_them():
    key = jax.random.key(3)
    assert jax.eval_shape(Pursuit().reset, key)[1].paths is None
    weights = dict(distance=0.0, collision=0.0, path=0.5)
    # points that stop: which physics it is, paths don't ask
    game = make(reward=weights, physics="stops")
    _, state = jax.jit(game.reset)(key)
    action = jnp.broadcast_to(hover_action(game.vehicle), (3, 4))
    _, state, reward, *_ = jax.jit(game.step)(None, state, action)
    way = length(state.task, state.drones.position, state.evader_position)
    np.testing.assert_allclose(reward, -0.5 * way, rtol=1e-5)
