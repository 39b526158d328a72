"""The tasks on which rare failures are counted are as hard as their names say, and start clear."""

import jax
import numpy as np
import pytest

from experiments.paper import hard_tasks
from openjax.pursuit import PursuitSettings
from openjax.pursuit.task import starts_clear

pytestmark = pytest.mark.slow

SETTINGS = PursuitSettings()


def test_close_tasks_leave_little_room_and_rows_are_in_line():
    close = hard_tasks.drawn(SETTINGS, hard_tasks.close, 256)
    rows = hard_tasks.drawn(SETTINGS, hard_tasks.row, 256)
    for tasks in (close, rows):
        assert np.asarray(jax.vmap(lambda task: starts_clear(SETTINGS, task))(tasks)).all()

    position = np.asarray(close.pursuer_position)
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 9 * np.eye(3)
    axis = np.linalg.norm(position[:, :, None, :2] - np.asarray(close.pillar_position)[:, None], axis=-1)
    axis = np.where(np.asarray(close.pillar_active)[:, None], axis, 9.0)
    near = (apart.min(axis=-1) < 0.14 + 0.05 + 1e-5) | (axis.min(axis=-1) < 0.17 + 0.05 + 1e-5)
    assert near.mean() > 0.8

    # pillars that weren't in the way of a start lie on one line: an outlier in most, none in many, hardly any by chance
    def straight(tasks):
        for pillars, used in zip(
            np.asarray(tasks.pillar_position), np.asarray(tasks.pillar_active), strict=True
        ):
            offset = pillars[used] - pillars[used].mean(axis=0)
            yield np.linalg.svd(offset, compute_uv=False)[1] < 1e-4

    assert np.mean([*straight(rows)]) > 0.2 > 0.1 > np.mean([*straight(close)])
