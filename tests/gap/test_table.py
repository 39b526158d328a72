"""The algebra of decisions against plain least squares."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize

from openjax.gap.model.bounds import BOUND, held_objective
from openjax.gap.model.cross_validation import judge
from openjax.gap.model.table import Model, Table, _errors

SHARED = np.array([True, True, False])


@pytest.fixture
def columns():
    """Whitened columns of two tracks: what is left, four candidates, three nuisances that explain a part of it."""
    rng = np.random.default_rng(0)
    out = []
    for _ in range(2):
        x = rng.standard_normal((8, 400))
        x[0] += 0.5 * x[2] + 0.1 * x[3] + 0.3 * x[5] - 0.4 * x[7]
        out.append(x)
    return out


def table_of(columns) -> Table:
    blocks = [b for x in columns for b in np.array_split(x, 4, axis=1)]
    white = np.array([b @ b.T for b in blocks])
    return Table(
        SimpleNamespace(effects=(), theta=np.zeros(0)), white, np.repeat(white[:, None], 6, 1), np.full(8, 100),
        np.repeat([0, 1], 4), np.repeat([0, 1, 2, 3], 2), {}, {}, {}, SHARED,
        np.ones(6), blocks,
    )  # fmt: skip


def test_what_half_a_track_cannot_show_of_its_clock_is_not_foretold(columns):
    # The track's own nuisance is silent in the first half and rules the second: the first knows nothing of it.
    for x in columns:
        x[0] -= 0.3 * x[5] - 0.4 * x[7]
        x[7, :200] *= 1e-3
        x[0, 200:] += 1.5 * x[7, 200:]
    model = Model((), np.array([3]), np.zeros(1), np.eye(1))
    nats = judge(table_of(columns), model).nats
    assert abs(nats.reshape(4, 2).sum(1).min() / nats.reshape(4, 2).sum(1).max() - 1.0) < 0.5


def test_without_a_pose_the_accelerometer_says_what_the_velocity_became():
    rng = np.random.default_rng(1)
    specific = rng.standard_normal((1, 200, 3))
    x = np.concatenate([np.zeros((1, 200, 6)), specific], 2)
    blind = _errors(x, 0.01, np.array([1, 1, 1, 0, 0, 0, 1, 1, 1]))
    np.testing.assert_allclose(blind[0, 60, 3:], 0.01 * specific[0, 36:61].sum(0), rtol=1e-9)
    assert not _errors(x, 0.01, np.ones(9)).any()


def test_nuisances_of_the_vehicle_are_alike_on_all_tracks_and_bounded(columns):
    left = [
        x[0] + s * 5.0 * x[6] for x, s in zip(columns, (1.0, -1.0), strict=True)
    ]  # the second would differ in sign
    left = [r + 3.0 * x[5] for r, x in zip(left, columns, strict=True)]  # and the first be beyond its bound
    off, precision = np.array([0.2]), np.array([[4.0]])
    rows = [np.concatenate([[r], x[2:3], x[5:]]) for r, x in zip(left, columns, strict=True)]
    found = held_objective([x @ x.T for x in rows], SHARED, off, precision)

    def objective(z):
        step, common, own = z[:1], z[1:3], z[3:]
        value = 0.5 * 4.0 * (off[0] + step[0]) ** 2 + 0.5 * (common @ common + own @ own)
        for k, (r, x) in enumerate(zip(left, columns, strict=True)):
            value += 0.5 * ((r - step @ x[2:3] - common @ x[5:7] - own[k] * x[7]) ** 2).sum()
        return value

    bounds = [(None, None)] + [(-BOUND, BOUND)] * 4
    best = minimize(objective, np.zeros(5), bounds=bounds, options={"ftol": 1e-14}).fun
    np.testing.assert_allclose(found, best, rtol=1e-3)
    assert found >= best - 1e-6 * best
