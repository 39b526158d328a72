"""The worth of a model of a table's columns: fitted to all blocks but one, judged on
that one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.model.blocks import block_diagonal
from openjax.gap.model.bounds import solve_bounded
from openjax.gap.model.library import places
from openjax.gap.model.table import Model, Table


@dataclass(frozen=True, eq=False)
class Validation:
    """A model on B blocks, each left out of the fit by which it is judged."""

    nats: np.ndarray
    """(B,) minus half the whitened sum of squares, a block's own nuisances
    marginalised.
    """
    squares: np.ndarray
    """(B, K) of the errors of logged channels."""
    nuisance_sizes: np.ndarray
    """(B, N) what the shared nuisances took."""
    residuals: np.ndarray
    """(M,) whitened residuals and own nuisances, block after block."""
    starts: np.ndarray
    """(B,) where each block begins in it."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of a model on a table: of its free columns and the nuisances
    that all flights share. What belongs to a block alone is marginalised already.
    """

    table: Table
    model: Model

    @cached_property
    def columns(self) -> np.ndarray:
        """The table's columns whose coefficients are solved for."""
        return np.concatenate([self.model.free, self.table.nuisances[self.table.is_shared]])

    def solve(self, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hessian, right side and solution from `table.marginal` summed (C, C) over the
        blocks to fit.
        """
        hessian = sums[np.ix_(self.columns, self.columns)]
        free = len(self.model.free)
        push = sums[self.columns][:, [0, *self.model.parts]].sum(1)
        hessian += block_diagonal([self.model.precision, np.eye(len(push) - free)])
        push[:free] += self.model.precision @ self.model.mean
        return hessian, push, solve_bounded(hessian, push, free)

    def coefficients(self, solution: np.ndarray, block: int) -> np.ndarray:
        """Coefficients (C,) of every column on a block, whose own nuisances are the
        most likely ones.
        """
        out = np.zeros(self.table.size)
        out[[0, *self.model.parts]] = 1.0
        out[self.columns] -= solution
        out[self.table.block_nuisances] = -self.table.projection[block] @ out
        return out


def promise_unbounded(table: Table, model: Model) -> float:
    """`promise` with nuisances of any size, which costs next to nothing."""
    columns = [0, *model.parts]
    hessian = table.fully_marginal[np.ix_(model.free, model.free)] + model.precision
    push = table.fully_marginal[model.free][:, columns].sum(1) + model.precision @ model.mean
    square = table.fully_marginal[np.ix_(columns, columns)].sum()
    return float(0.5 * push @ np.linalg.solve(hessian, push) - 0.5 * square)


def promise(table: Table, model: Model) -> float:
    """Log posterior of a model at its best, fitted to all blocks, up to what all of a
    table share: what screening needs.
    """
    sums = table.total
    columns = [0, *model.parts]
    hessian, push, solution = Equations(table, model).solve(sums)
    square = sums[np.ix_(columns, columns)].sum()
    return float(push @ solution - 0.5 * solution @ hessian @ solution - 0.5 * square)


def fit_to_others(table: Table, model: Model) -> np.ndarray:
    """Coefficients (B, C) of a model on each block, fitted to all others."""
    equations = Equations(table, model)
    sums = table.total
    others = (equations.solve(sums - block)[2] for block in table.marginal)
    return np.array([equations.coefficients(solution, k) for k, solution in enumerate(others)])


def cross_validate(table: Table, model: Model) -> Validation:
    """The model on each block, fitted to all others."""
    coefficients = fit_to_others(table, model)
    # |y - Nv|^2 + |v|^2 at its least is y'(I + NN')^-1 y: what a block's nuisances take
    # costs.
    each = zip(coefficients, table.columns, strict=True)
    residuals = [np.concatenate([u @ columns, u[table.block_nuisances]]) for u, columns in each]
    return Validation(
        nats=np.array([-0.5 * (r @ r) for r in residuals]),
        squares=_squares(table.errors, coefficients),
        nuisance_sizes=-coefficients[:, table.nuisances[table.is_shared]],
        residuals=np.concatenate(residuals),
        starts=np.cumsum([0, *map(len, residuals)])[:-1],
    )


def _squares(errors: list, coefficients: np.ndarray) -> np.ndarray:
    """Squared errors (B, K) of columns' errors [(C, T, K)] with coefficients (B, C)."""
    each = zip(coefficients, errors, strict=True)
    return np.array([np.square(np.tensordot(c, e, 1)).sum(0) for c, e in each])


def ablate(
    table: Table, coefficients: np.ndarray, drop=(), off: np.ndarray | None = None
) -> np.ndarray:
    """Squared errors (B, K) of a table's set with `coefficients` (B, C) of
    `fit_to_others`, without the effects `drop` and the nuisances `off` (N,); everything
    else stays as fitted.
    """
    coefficients = coefficients.copy()
    remaining = [e for e in table.fit.effects if e not in drop]
    shared_places = {int(i) for e in remaining for i in places((e,))}
    for effect in drop:
        # parameters that another effect shares stay as they were fitted
        columns = [
            table.derivative[int(i)] for i in places((effect,)) if int(i) not in shared_places
        ]
        coefficients[:, columns] = 0.0
        coefficients[:, table.part[effect]] = 1.0
    if off is not None:
        coefficients[:, table.nuisances[off]] = 0.0
    return _squares(table.errors, coefficients)
