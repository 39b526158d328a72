"""The algebra of decisions against plain least squares."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize

from openjax.gap.decision import DECISION
from openjax.gap.model.cross_validation import Equations, cross_validate, promise, promise_unbounded
from openjax.gap.model.hypotheses import _loudness
from openjax.gap.model.library import ABSENT
from openjax.gap.model.table import Model, Table, _errors


@pytest.fixture
def columns():
    """Whitened columns of two tracks: what is left, four candidates, three nuisances
    that explain a part of it.
    """
    rng = np.random.default_rng(0)
    out = []
    for _ in range(2):
        x = rng.standard_normal((8, 400))
        x[0] += 0.5 * x[2] + 0.1 * x[3] + 0.3 * x[5] - 0.4 * x[7]
        out.append(x)
    return out


def test_the_gap_holds_the_accelerometer_against_the_velocity_that_it_says():
    """So a push that nuisances of the path could take, as a leaning world takes wind,
    still shows.
    """
    specific = np.random.default_rng(1).standard_normal((1, 200, 3))
    errors = _errors(np.concatenate([np.zeros((1, 200, 6)), specific], 2), 0.01)
    np.testing.assert_allclose(errors[0, 60, 6:], 0.01 * specific[0, 36:61].sum(0), rtol=1e-9)
    assert not errors[..., :6].any()


def test_a_loud_second_counts_less_in_its_own_axes_and_in_no_other():
    replay = SimpleNamespace(
        tracks=[SimpleNamespace(dt=0.01)], whiten=lambda residual, track: residual
    )
    residual = np.random.default_rng(2).standard_normal((400, 9))
    residual[200:300, 3:5] *= 7.0
    loudness = _loudness(replay, residual, 0)
    expected = np.ones((400, 9))
    expected[200:300, 3:5] = 7.0
    np.testing.assert_allclose(loudness, expected, rtol=0.25)


def test_nuisances_of_the_vehicle_are_alike_on_all_blocks_and_bounded_and_a_blocks_own_are_marginalised(
    columns,
):
    left = [
        x[0] + s * 5.0 * x[6] for x, s in zip(columns, (1.0, -1.0), strict=True)
    ]  # the second would differ in sign
    left = [
        r + 3.0 * x[5] for r, x in zip(left, columns, strict=True)
    ]  # and the first be beyond its bound
    rows = [np.concatenate([r[None], x[2:3], x[5:]]) for r, x in zip(left, columns, strict=True)]
    shared = np.array([True, True, False])
    order = np.arange(2)
    white = np.array([x @ x.T for x in rows])
    table = Table(None, white, None, None, order, {}, {}, {}, shared, rows)
    model = Model((), np.array([1]), np.array([-0.2]), np.array([[4.0]]))
    equations = Equations(table, model)
    found = equations.solve(table.marginal.sum(0))[2]
    own = [equations.coefficients(found, k)[4] for k in range(2)]

    def objective(z):
        step = z[:1]
        common = z[1:3]
        own = z[3:]
        value = 0.5 * 4.0 * (0.2 + step[0]) ** 2 + 0.5 * (common @ common + own @ own)
        for k, (r, x) in enumerate(zip(left, columns, strict=True)):
            value += 0.5 * ((r - step @ x[2:3] - common @ x[5:7] - own[k] * x[7]) ** 2).sum()
        return value

    bound = DECISION.nuisance_bound
    bounds = [(None, None)] + [(-bound, bound)] * 2 + [(None, None)] * 2
    best = minimize(objective, np.zeros(5), bounds=bounds, options={"ftol": 1e-14})
    np.testing.assert_allclose(
        objective(np.array([*found, *(-u for u in own)])), best.fun, rtol=1e-6
    )
    assert np.abs(found[1:]).max() <= bound


def test_a_block_left_out_is_judged_by_its_marginal_density(columns):
    """-1/2 y'(I + NN')^-1 y: what a block's own nuisances take of it costs."""
    rows = [x[[0, 7]] for x in columns]
    white = np.array([x @ x.T for x in rows])
    shared = np.array([False])
    fit = SimpleNamespace(effects=(), replay=SimpleNamespace(absent=ABSENT), theta=ABSENT)
    errors = [np.arange(12.0).reshape(2, 3, 2), np.ones((2, 4, 2))]
    table = Table(fit, white, errors, None, np.arange(2), {}, {}, {}, shared, rows)
    model = Model((), np.array([], int), np.zeros(0), np.zeros((0, 0)))
    found = cross_validate(table, model)
    for (y, n), nats in zip(rows, found.nats, strict=True):
        expected = -0.5 * y @ np.linalg.solve(np.eye(len(y)) + np.outer(n, n), y)
        assert nats == pytest.approx(expected, rel=1e-9)
    for (y, n), squares, error in zip(rows, found.squares, errors, strict=True):
        size = y @ n / (1.0 + n @ n)
        np.testing.assert_allclose(squares, ((error[0] - size * error[1]) ** 2).sum(0))


def test_screening_promises_what_a_fit_does_where_no_nuisance_is_at_its_bound(columns):
    rows = [np.concatenate([x[:3], 0.2 * x[5:7]]) for x in columns]
    white = np.array([x @ x.T for x in rows])
    shared = np.array([True, True])
    table = Table(None, white, None, None, np.arange(2), {}, {}, {}, shared, rows)
    model = Model((), np.array([1, 2]), np.array([0.1, -0.2]), np.diag([4.0, 9.0]))
    nothing = Model((), np.array([], int), np.zeros(0), np.zeros((0, 0)))
    gains = [f(table, model) - f(table, nothing) for f in (promise_unbounded, promise)]
    assert np.abs(Equations(table, model).solve(table.total)[2][2:]).max() < DECISION.nuisance_bound
    assert gains[0] == pytest.approx(gains[1], rel=1e-6)
