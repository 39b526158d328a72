"""What a model of a table's columns is worth: fitted to all folds but one, judged on that one."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from openjax.gap.model.bounds import bounded
from openjax.gap.model.library import prior
from openjax.gap.model.table import Model, Table, with_effects


@dataclass(frozen=True, eq=False)
class Judged:
    """A model on stretches left out: `nats` (B,) minus half the whitened sum of squares, `squares` (B, 6) of the
    errors, `taken` (folds, N) of the shared nuisances."""

    nats: np.ndarray
    squares: np.ndarray
    taken: np.ndarray
    left: np.ndarray  # (M,) whitened residuals, block after block
    starts: np.ndarray  # (B,) where each block begins


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of a model on a table: of its free columns and the nuisances that all flights share. What belongs to a
    fold alone is marginalised already."""

    table: Table
    model: Model

    @cached_property
    def columns(self) -> np.ndarray:
        return np.concatenate([self.model.free, self.table.nuisances[self.table.shared]])

    def solve(self, fold: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hessian, right side and solution over all folds but one."""
        sums = self.table.folds.sum(0) - (0.0 if fold is None else self.table.folds[fold])
        hessian, free = sums[np.ix_(self.columns, self.columns)], len(self.model.free)
        push = sums[self.columns][:, [0, *self.model.parts]].sum(1)
        hessian += block_diag(self.model.precision, np.eye(len(push) - free))
        push[:free] += self.model.precision @ self.model.mean
        return hessian, push, bounded(hessian, push, free)

    def coefficients(self, found: np.ndarray, fold: int) -> np.ndarray:
        """Coefficients (C,) of every column on a fold, whose own nuisances are the most likely ones."""
        out = np.zeros(self.table.size)
        out[[0, *self.model.parts]] = 1.0
        out[self.columns] -= found
        out[self.table.own] = -self.table.taken[fold] @ out
        return out


def promise(table: Table, model: Model) -> float:
    """Log posterior of a model at its best, fitted to all folds, up to what all models of a table share: what screening needs."""
    hessian, push, found = Equations(table, model).solve(None)
    own = [0, *model.parts]
    square = table.folds.sum(0)[np.ix_(own, own)].sum()
    return float(push @ found - 0.5 * found @ hessian @ found - 0.5 * square)


def left_out(table: Table, model: Model):
    """Of every fold its blocks, and the coefficients (C,) of a model fitted to all others."""
    equations = Equations(table, model)
    for fold in range(len(table.folds)):
        yield table.blocks_of(fold), equations.coefficients(equations.solve(fold)[2], fold)


def judge(table: Table, model: Model) -> Judged:
    """The model on each fold, fitted to all others."""
    nats, squares = np.zeros(len(table.white)), np.zeros((len(table.white), 6))
    taken, left = [], [np.zeros(0)] * len(table.white)
    for blocks, u in left_out(table, model):
        for k in range(blocks.start, blocks.stop):
            left[k] = u @ table.columns[k]
        nats[blocks] = -0.5 * (table.white[blocks] @ u) @ u
        squares[blocks] = (table.error[blocks] @ u) @ u
        taken.append(-u[table.nuisances[table.shared]])
    starts = np.cumsum([0, *map(len, left)])[:-1]
    return Judged(nats, squares, np.array(taken), np.concatenate(left), starts)


class Ablation:
    """A table's set fitted to all folds but one, whose effects and nuisances may go while everything else stays as fitted."""

    def __init__(self, table: Table):
        self.table = table
        self.left_out = list(left_out(table, with_effects(table)))

    def squares(self, drop=(), off: np.ndarray | None = None) -> np.ndarray:
        """Squared errors (B, 6) on each fold without the effects `drop` and the nuisances `off` (N,)."""
        table, squares = self.table, np.zeros((len(self.table.white), 6))
        kept = {int(i) for e in table.fit.effects if e not in drop for i in prior((e,))[0]}
        for blocks, solution in self.left_out:
            u = solution.copy()
            for effect in drop:
                u[[table.derivative[int(i)] for i in prior((effect,))[0] if int(i) not in kept]] = 0.0
                u[table.part[effect]] = 1.0
            if off is not None:
                u[table.nuisances[off]] = 0.0
            squares[blocks] = (table.error[blocks] @ u) @ u
        return squares


def level(squares: np.ndarray, floor: np.ndarray) -> float:
    """The gap: rms over channels of each channel's error over its floor (6,), both sums over the same rows."""
    use = floor > 0
    return float(np.sqrt(np.mean(squares.sum(0)[use] / floor[use])))
