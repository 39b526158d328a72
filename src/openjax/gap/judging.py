"""What a model of a table's columns is worth: fitted to all folds but one, judged on that one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.bounds import bounded, normal_equations
from openjax.gap.library import prior
from openjax.gap.table import Model, Table, widened


@dataclass(frozen=True, eq=False)
class Judged:
    """A model on stretches left out: `nats` (B,) minus half the whitened sum of squares, `squares` (B, 6) of the
    errors, `taken` (folds, N) of the shared nuisances."""

    nats: np.ndarray
    squares: np.ndarray
    taken: np.ndarray


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of a model on a table: of its free columns, the case's nuisances and each track's, in that order."""

    table: Table
    model: Model

    @cached_property
    def nuisances(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns of the nuisances that the model uses: the case's and a track's."""
        every, shared = self.table.nuisances, self.table.shared
        if self.model.bound == 0.0:
            return every[:0], every[:0]
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

    def of_track(self, track: int, but: int | None = None) -> tuple[np.ndarray, np.ndarray] | None:
        """Their sums over all folds of a track, or all but one; None where none is left."""
        used = [f for f in np.flatnonzero(self.table.folds[1] == track) if f != but]
        return tuple(of[used].sum(0) for of in self.folds) if used else None

    @cached_property
    def tracks(self) -> list:
        """`of_track` of every track."""
        return [self.of_track(k) for k in range(int(self.table.folds[1].max()) + 1)]

    def without(self, fold: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Hessian and right side over all folds but one."""
        parts = list(self.tracks)
        if fold is not None:
            track = self.table.folds[1][fold]
            parts[track] = self.of_track(track, fold)
        push = self.model.precision @ self.model.mean
        return normal_equations(self.model.precision, push, *map(len, self.nuisances), parts)

    def solved(self, fold: int | None = None) -> np.ndarray:
        """Solution over all folds but one, whose track has its own nuisances fitted to all of it."""
        hessian, push = self.without(fold)
        found, _ = bounded(hessian, push, len(self.model.free), self.model.bound)
        return found if fold is None else self.own_again(found[None], self.table.folds[1][fold])[0]

    def own_again(self, found: np.ndarray, track: int) -> np.ndarray:
        """Solutions (K, size) with a track's own nuisances fitted to all of it, everything else as it was `found`: they are of
        its sensors and clocks, and what the rest of the track can't show of them isn't to be foretold."""
        common, own = self.common, len(self.nuisances[1])
        gram, target = self.tracks[track]
        hessian, push = (
            np.eye(own) + gram[common:, common:],
            target[common:] - found[:, :common] @ gram[:common, common:],
        )
        free = np.linalg.solve(hessian, push.T).T
        found, mine = found.copy(), slice(common + own * track, common + own * (track + 1))
        for each, alone, right in zip(found, free, push, strict=True):
            inside = (np.abs(alone) <= self.model.bound).all()
            each[mine] = alone if inside else bounded(hessian, right, 0, self.model.bound)[0]
        return found

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


def solve(table: Table, model: Model) -> np.ndarray:
    """Coefficients (tracks, C) of every column, fitted to all folds."""
    equations = Equations(table, model)
    found = equations.solved()
    return np.stack([equations.coefficients(found, k) for k in range(len(equations.tracks))])


def left_out(table: Table, model: Model):
    """Of every fold its blocks, and the coefficients (C,) of a model fitted to all others."""
    equations = Equations(table, model)
    for fold, track in enumerate(table.folds[1]):
        yield table.blocks_of(fold), equations.coefficients(equations.solved(fold), track)


def judge(table: Table, model: Model) -> Judged:
    """The model on each fold, fitted to all others."""
    nats, squares = np.zeros(len(table.white)), np.zeros((len(table.white), 6))
    taken = []
    for blocks, u in left_out(table, model):
        nats[blocks] = -0.5 * (table.white[blocks] @ u) @ u
        squares[blocks] = (table.error[blocks] @ u) @ u
        taken.append(-u[table.nuisances[table.shared]])
    return Judged(nats, squares, np.array(taken))


def keep(table: Table, model: Model, drop=(), off: np.ndarray | None = None) -> np.ndarray:
    """Squared errors (B, 6) on each fold of a model fitted to all others, once the effects `drop` and the nuisances `off`
    (N,) go and everything else stays as fitted."""
    squares = np.zeros((len(table.white), 6))
    for blocks, u in left_out(table, model):
        for effect in drop:
            others = {int(i) for e in table.fit.effects if e not in drop for i in prior((e,))[0]}
            own = [table.derivative[int(i)] for i in prior((effect,))[0] if int(i) not in others]
            u[own] = 0.0
            u[table.part[effect]] = 1.0
        if off is not None:
            u[table.nuisances[off]] = 0.0
        squares[blocks] = (table.error[blocks] @ u) @ u
    return squares


def offers(table: Table, model: Model, columns: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Nats (K, B) on each fold of the model with one more of `columns` (K,) free, whose coefficient has `precision` (K,) about
    none: `judge` for each, with the nuisances that are at their bounds left there."""
    wide = Equations(table, widened(model, columns, precision))
    added = len(model.free) + np.arange(len(columns))
    nats = np.zeros((len(columns), len(table.white)))
    for fold, track in enumerate(table.folds[1]):
        hessian, push = wide.without(fold)
        kept = np.setdiff1d(np.arange(len(push)), added)
        found, open_ = bounded(hessian[np.ix_(kept, kept)], push[kept], len(model.free), model.bound)
        inside = kept[open_]
        follow = np.linalg.solve(hessian[np.ix_(inside, inside)], hessian[np.ix_(inside, added)])
        stiff = hessian[added, added] - (hessian[np.ix_(inside, added)] * follow).sum(0)
        size = (push[added] - hessian[np.ix_(added, kept)] @ found) / stiff
        whole = np.zeros((len(columns), len(push)))
        whole[:, kept] = found
        whole[:, inside] -= (follow * size).T
        whole[np.arange(len(columns)), added] = size
        u, blocks = wide.coefficients(wide.own_again(whole, track), track), table.blocks_of(fold)
        nats[:, blocks] = -0.5 * ((u @ table.white[blocks]) * u).sum(2).T
    return nats


def level(squares: np.ndarray, floor: np.ndarray) -> float:
    """The gap: rms over channels of each channel's error over its floor (6,), both sums over the same rows."""
    use = floor > 0
    return float(np.sqrt(np.mean(squares.sum(0)[use] / floor[use])))
