"""What a model of a table's columns is worth: fitted to all folds but one, judged on that one."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.model.bounds import bounded, normal_equations
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
    """Normal equations of a model on a table: of its free columns, the case's nuisances and each track's, in that order."""

    table: Table
    model: Model

    @cached_property
    def nuisances(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns of the nuisances that the model uses: the case's and a track's."""
        every, shared = self.table.nuisances, self.table.shared
        return every[shared], every[~shared]

    @property
    def common(self) -> int:
        """Number of unknowns that all tracks share."""
        return len(self.model.free) + len(self.nuisances[0])

    @cached_property
    def folds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of every fold inner products (folds, c, c) of the columns, and (folds, c) with what the model has to explain."""
        columns = np.concatenate([self.model.free, *self.nuisances])
        sums = self.table.folds[0][:, columns]
        return sums[:, :, columns], sums[:, :, 0] + sums[:, :, list(self.model.parts)].sum(2)

    def of_track(self, track: int, but: int | None) -> tuple[np.ndarray, np.ndarray] | None:
        """Their sums over all folds of a track but one; None where none is left."""
        used = [f for f in np.flatnonzero(self.table.folds[1] == track) if f != but]
        return tuple(of[used].sum(0) for of in self.folds) if used else None

    def without(self, fold: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Hessian and right side over all folds but one."""
        parts = [self.of_track(k, fold) for k in range(int(self.table.folds[1].max()) + 1)]
        push = self.model.precision @ self.model.mean
        return normal_equations(self.model.precision, push, *map(len, self.nuisances), parts)

    def coefficients(self, found: np.ndarray, track: int) -> np.ndarray:
        """Coefficients (..., C) of every column on one track, from solutions (..., size)."""
        free, (shared, own) = len(self.model.free), self.nuisances
        out = np.zeros((*found.shape[:-1], self.table.size))
        out[..., 0] = 1.0
        out[..., list(self.model.parts)] = 1.0
        out[..., self.model.free] -= found[..., :free]
        out[..., shared] = -found[..., free : self.common]
        out[..., own] = -found[..., self.common + len(own) * track :][..., : len(own)]
        return out


def promise(table: Table, model: Model) -> float:
    """Log posterior of a model at its best, fitted to all folds, up to what all models of a table share: what screening needs."""
    equations, own = Equations(table, model), [0, *model.parts]
    hessian, push = equations.without(None)
    found = bounded(hessian, push, len(model.free))
    square = table.folds[0].sum(0)[np.ix_(own, own)].sum()
    return float(push @ found - 0.5 * found @ hessian @ found - 0.5 * square)


def left_out(table: Table, model: Model):
    """Of every fold its blocks, and the coefficients (C,) of a model fitted to all others."""
    equations = Equations(table, model)
    for fold, track in enumerate(table.folds[1]):
        yield (
            table.blocks_of(fold),
            equations.coefficients(bounded(*equations.without(fold), len(model.free)), track),
        )


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
