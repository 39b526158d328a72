"""Invariants of the task archive on random sequences of insertions, against the same
rule in plain Python.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openjax.learning.archive import draw, empty_archive, insert
from openjax.pursuit import PursuitSettings, Task, empty_task, task_descriptor

CAPACITY = 5
ENTERING = 4
GAME = PursuitSettings(num_pursuers=1, min_pillars=0, max_pillars=1)


def tasks_at(points):
    """Tasks that differ in the x, y of their pursuer (0.25 m steps: exact in
    float32).
    """
    points = np.asarray(points, np.float32).reshape(-1, 2)
    number = len(points)
    return Task(
        pursuer_position=jnp.asarray(np.c_[0.25 * points, np.zeros(number)][:, None], jnp.float32),
        evader_position=jnp.zeros((number, 3)),
        pillar_position=jnp.zeros((number, 1, 2)),
        pillar_active=jnp.zeros((number, 1), bool),
    )


def points_of(archive):
    """Content, slot by slot: (x, y, success rate)."""
    size = int(archive.size)
    xy = 4 * np.asarray(archive.tasks.pursuer_position)[:size, 0, :2]
    return [(*map(float, p), float(s)) for p, s in zip(xy, archive.success[:size], strict=True)]


@pytest.fixture(scope="module")
def enter():
    compiled = jax.jit(functools.partial(insert, descriptor=task_descriptor))

    def call(archive, points, accepted, success):
        return compiled(
            archive, tasks_at(points), jnp.asarray(success, jnp.float32), jnp.asarray(accepted)
        )

    return call


def reference(content, points, accepted, success):
    """Newest first; where there are too many, those farthest from the nearest newer one
    stay.
    """
    new = [(*map(float, p), s) for p, a, s in zip(points, accepted, success, strict=True) if a][
        ::-1
    ]
    pool = new + content
    novelty = [
        min([np.inf] + [(x - a) ** 2 + (y - b) ** 2 for a, b, _ in pool[:i]])
        for i, (x, y, _) in enumerate(pool)
    ]
    kept = sorted(range(len(pool)), key=lambda i: (-novelty[i], i))[:CAPACITY]
    return [pool[i] for i in sorted(kept)]


point = st.tuples(st.integers(-3, 3), st.integers(-3, 3))
entry = st.tuples(point, st.booleans())
insertion = st.lists(entry, min_size=ENTERING, max_size=ENTERING)


@given(insertions=st.lists(insertion, min_size=1, max_size=5))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_invariants(enter, insertions):
    archive = empty_archive(empty_task(GAME), CAPACITY)
    content = []
    serial = 0
    for entering in insertions:
        points = [p for p, _ in entering]
        accepted = [a for _, a in entering]
        success = [float(serial + i) for i in range(ENTERING)]  # tells every task apart
        serial += ENTERING
        before = content
        content = reference(content, points, accepted, success)
        archive = enter(archive, points, accepted, success)
        got = points_of(archive)
        assert got == content
        # and what this rule is for, said outright
        pool = before + [
            (*map(float, p), s) for p, a, s in zip(points, accepted, success, strict=True) if a
        ]
        assert len(got) == min(len(pool), CAPACITY)
        assert set(got) <= set(pool)  # nothing that wasn't accepted
        ages = [s for _, _, s in got]
        assert ages == sorted(ages, reverse=True)  # newest first
        places = {p[:2] for p in pool}
        assert len({p[:2] for p in got}) == min(
            len(places), CAPACITY
        )  # no copy while something else is left


def test_of_a_cluster_the_older_go_first(enter):
    archive = empty_archive(empty_task(GAME), CAPACITY)
    archive = enter(archive, [(-3, 0), (0.1, 0), (0.2, 0), (3, 0)], [True] * 4, [1, 2, 3, 4])
    archive = enter(archive, [(0.3, 0), (0.4, 0), (0, 3), (0, -3)], [True] * 4, [5, 6, 7, 8])
    # 6 is the cluster's newest; of its older members none stays before the four far
    # ones
    assert [s for *_, s in points_of(archive)] == [8, 7, 6, 4, 1]


def test_unused_pillars_do_not_tell_tasks_apart():
    tasks = tasks_at([(1, 1), (1, 1)]).replace(
        pillar_position=jnp.array([[[0.5, 0.5]], [[0.0, 0.2]]])
    )
    a, b = task_descriptor(tasks)
    np.testing.assert_array_equal(a, b)
    a, b = task_descriptor(tasks.replace(pillar_active=jnp.ones((2, 1), bool)))
    assert np.any(a != b)


def test_draws_are_uniform_over_used_slots(enter):
    archive = enter(
        empty_archive(empty_task(GAME), CAPACITY),
        [(1, 0), (2, 0), (3, 0), (4, 0)],
        [True, True, False, True],
        [0] * 4,
    )
    drawn = jax.jit(jax.vmap(lambda key: draw(archive, key)))(
        jax.random.split(jax.random.key(0), 3000)
    )
    x, number = np.unique(4 * np.asarray(drawn.pursuer_position[:, 0, 0]), return_counts=True)
    assert x.tolist() == [1, 2, 4]
    np.testing.assert_allclose(number, 1000, atol=120)
