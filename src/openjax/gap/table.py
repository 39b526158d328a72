"""Everything that a set of effects could still become, as small matrices: the case linearised around a fitted set.

A table holds, for every second of flight, inner products of all columns that a decision may combine - what is left,
its derivatives with respect to every parameter, what each further effect would do as it was fitted alone, what each
effect of the set does, and the nuisances - once whitened (likelihood) and once as errors of short predictions (gap). So
adding, dropping and swapping effects on stretches left out costs nothing but linear algebra.

Nuisances are bounded: numbers of the vehicle are shared by all flights of the case, biases and clocks belong to a track,
and each stays within twice its usual size. One that ends there is a finding."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.bounds import BOUND, bounded, normal_equations
from openjax.gap.hypotheses import SetFit, linearised_at
from openjax.gap.library import ABSENT, CARDS, PLACE, places, prior
from openjax.gap.replay import SKIP, Replay

BLOCK = 1.0  # s: gusts and sensors forget within less
HORIZONS = {"velocity": 0.25, "rates": 0.05}  # s of the predictions whose errors are the gap
ERRORS = tuple((f"{kind} {axis}", 3 * number + k) for number, kind in enumerate(("rates", "velocity"))
               for k, axis in enumerate("xyz"))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Table:
    """`white` (B, C, C) and `error` (B, 6, C, C) by block; `rows` (B,) that count; `track_of`, `flight_of`, `fold_of`
    (B,). Columns: 0 is what is left; `derivative` {place: column}; `step` {effect: column}; `part` {effect: column};
    `more` those that a caller
    added; the last are nuisances, of which `shared` (N,) are the case's and the others a track's."""

    fit: SetFit
    white: np.ndarray
    error: np.ndarray
    rows: np.ndarray
    track_of: np.ndarray
    flight_of: np.ndarray
    fold_of: np.ndarray
    derivative: dict[int, int]
    step: dict[str, int]
    part: dict[str, int]
    more: np.ndarray
    shared: np.ndarray
    usable: np.ndarray  # (6,) of the errors

    @property
    def size(self) -> int:
        return self.white.shape[1]

    @property
    def nuisances(self) -> np.ndarray:
        return np.arange(self.size - len(self.shared), self.size)

    @cached_property
    def folds(self) -> tuple[np.ndarray, np.ndarray]:
        """Whitened sums (folds, C, C), and the track (folds,) that each belongs to."""
        count = int(self.fold_of.max()) + 1
        sums = np.stack([self.white[self.fold_of == k].sum(0) for k in range(count)])
        return sums, np.array([self.track_of[np.argmax(self.fold_of == k)] for k in range(count)])


@dataclass(frozen=True, eq=False)
class Model:
    """One combination of a table's columns: column 0 and `parts` are there, the coefficients of `free` are fitted, with
    prior `mean` and `precision`; `bound`: the box of the nuisances in their usual sizes (0: without them)."""

    parts: tuple[int, ...]
    free: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    bound: float = BOUND


@dataclass(frozen=True, eq=False)
class Judged:
    """A model on stretches left out: `nats` (B,) minus half the whitened sum of squares, `squares` (B, 6) of the
    errors, `taken` (folds, N) of the shared nuisances."""

    nats: np.ndarray
    squares: np.ndarray
    taken: np.ndarray


def build(replay: Replay, fit: SetFit, singles: dict[str, SetFit], more=None) -> Table:
    """The table around a fitted set; `singles` {effect: its fit alone} are the effects that may come in, `more` [(K, T,
    9)] further columns of each track."""
    own = fit.effects
    others = [e for e in singles if e not in own]
    index = np.array(
        sorted({int(i) for e in (*own, *others) for i in places((e,))} | set(fit.index.tolist())), int
    )
    points = []
    for effect in others:
        point = fit.theta.copy()
        point[places((effect,))] = singles[effect].theta[places((effect,))]
        points.append(point)
    for effect in own:
        point = fit.theta.copy()
        point[places((effect,))] = ABSENT[places((effect,))]
        points.append(point)
    columns = linearised_at(replay, fit, index)
    moved = replay.predict(np.array(points)) if points else [np.zeros((0, *y.shape)) for y in replay.measured]
    white, error, rows, track_of, fold_of = [], [], [], [], []
    added = [()] * len(replay.tracks) if more is None else [(m,) for m in more]
    for number, (c, m, track) in enumerate(zip(columns, moved, replay.tracks, strict=True)):
        now = replay.measured[number] - c[0]
        nuisances = replay.nuisances[number]
        x = np.concatenate([c, m[: len(others)] - now, now - m[len(others) :], *added[number], nuisances])
        skip, size = int(SKIP / track.dt), max(int(BLOCK / track.dt), 1)
        w = np.concatenate([replay.whiten(x[: -len(nuisances)], number), replay.whitened_nuisances[number]])
        e = _errors(x, track.dt, replay.usable)
        count = max(w.shape[1] // size, 1)
        for k, (a, b) in enumerate(zip(np.array_split(w, count, 1), _split(e, skip, count), strict=True)):
            flat = a.reshape(len(x), -1)
            white.append(flat @ flat.T)
            error.append(np.einsum("ctk,dtk->kcd", b, b, optimize=True))
            rows.append(b.shape[1])
            track_of.append(number)
            fold_of.append(2 * number + (2 * k >= count))
    track_of = np.array(track_of)
    at = 1 + len(index)
    return Table(
        fit, np.array(white), np.array(error), np.array(rows), track_of, replay.flight_of[track_of],
        np.unique(fold_of, return_inverse=True)[1],
        {int(i): 1 + k for k, i in enumerate(index)},
        {e: at + k for k, e in enumerate(others)},
        {e: at + len(others) + k for k, e in enumerate(own)},
        at + len(others) + len(own) + np.arange(0 if more is None else len(more[0])),
        replay.shared,
        np.concatenate([replay.usable[:3], replay.usable[3:6] if replay.usable[3] else replay.usable[6:9]]),
    )  # fmt: skip


def _errors(x: np.ndarray, dt: float, usable: np.ndarray) -> np.ndarray:
    """Errors (C, T, 6) of predictions over HORIZONS that end at each row. Without a pose the accelerometer says what the
    velocity became, in axes of the body."""
    out = np.zeros((*x.shape[:2], 6))
    for k, kind in enumerate(("rates", "velocity")):
        step = max(round(HORIZONS[kind] / dt), 1)
        whole = x[..., 3 * k : 3 * k + 3]
        if kind == "velocity" and not usable[3]:
            whole = np.cumsum(x[..., 6:9], axis=1) * dt
        out[:, step:, 3 * k : 3 * k + 3] = whole[:, step:] - whole[:, :-step]
    return out


def _split(e: np.ndarray, skip: int, count: int) -> list[np.ndarray]:
    first = max(skip, 25)
    return np.array_split(e[:, first:], count, 1)


def with_effects(table: Table, add=(), drop=()) -> Model:
    """The table's set with effects that come in as they were fitted alone (and may move from there) or go."""
    kept = tuple(e for e in table.fit.effects if e not in drop)
    index, mean, precision = prior(kept)
    own = np.array([table.derivative[int(i)] for i in index], int)
    # The set's parameters: coefficients count from where they were fitted.
    mean = mean - table.fit.theta[index] if len(index) else mean
    free, means, blocks = [own], [mean], [precision]
    for effect in add:
        if effect in table.step:
            free.append(np.array([table.step[effect]]))
            means.append(np.array([0.0]))
            blocks.append(np.eye(1))
        spread = np.array([p.spread for p in CARDS[effect].fitted])
        inside = [k for k, i in enumerate(places((effect,))) if table.derivative[int(i)] not in own]
        free.append(np.array([table.derivative[int(places((effect,))[k])] for k in inside], int))
        means.append(np.zeros(len(inside)))
        blocks.append(np.diag(1.0 / spread[inside] ** 2))
    free = np.concatenate(free)
    size = len(free)
    out, at = np.zeros((size, size)), 0
    for block in blocks:
        out[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return Model(tuple(table.part[e] for e in drop), free.astype(int), np.concatenate(means), out)


def solve(table: Table, model: Model, left_out: int | None = None) -> np.ndarray:
    """Coefficients (tracks, C) of every column, fitted to all folds but one."""
    hessian, push = _equations(table, model, left_out)
    found, _ = bounded(hessian, push, len(model.free), model.bound)
    if left_out is not None:
        _own_again(table, model, found, table.folds[1][left_out])
    return np.stack([_spread(table, model, found, k) for k in range(len(np.unique(table.track_of)))])


def _own_again(table: Table, model: Model, found: np.ndarray, track: int) -> None:
    """Fit a track's own nuisances to all of it, everything else as it was `found`: they are of its sensors and clocks, and
    what the rest of the track can't show of them isn't to be foretold."""
    sums, tracks = table.folds
    shared, own = _nuisances(table, model)
    fixed = np.concatenate([model.free, shared])
    gram = sums[tracks == track].sum(0)
    target = _target(gram, model) - gram[:, fixed] @ found[: len(fixed)]
    place = len(fixed) + len(own) * int(np.searchsorted(np.unique(table.track_of), track))
    hessian = np.eye(len(own)) + gram[np.ix_(own, own)]
    found[place : place + len(own)] = bounded(hessian, target[own], 0, model.bound)[0]


def _target(gram: np.ndarray, model: Model) -> np.ndarray:
    """(C,) products of every column with what the model has to explain."""
    return gram[:, 0] + gram[:, list(model.parts)].sum(1)


def _nuisances(table: Table, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the nuisances that the model uses: the case's and a track's."""
    if model.bound == 0.0:
        return table.nuisances[:0], table.nuisances[:0]
    return table.nuisances[table.shared], table.nuisances[~table.shared]


def _equations(table: Table, model: Model, left_out: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the model's free columns, the case's nuisances and each track's, over all folds but one."""
    sums, tracks = table.folds
    names = np.unique(table.track_of)
    shared, own = _nuisances(table, model)
    columns = np.concatenate([model.free, shared, own])
    parts = []
    for track in names:
        used = [f for f in np.flatnonzero(tracks == track) if f != left_out]
        gram = sums[used].sum(0)
        target = _target(gram, model)
        parts.append((gram[np.ix_(columns, columns)], target[columns]) if used else None)
    return normal_equations(model.precision, model.precision @ model.mean, len(shared), len(own), parts)


def _spread(table: Table, model: Model, found: np.ndarray, track: int) -> np.ndarray:
    """Coefficients (..., C) of every column on one track, from solutions (..., size) of the equations."""
    shared, own = _nuisances(table, model)
    p, s, n = len(model.free), len(shared), len(own)
    out = np.zeros((*found.shape[:-1], table.size))
    out[..., 0] = 1.0
    out[..., list(model.parts)] = 1.0
    out[..., model.free] -= found[..., :p]
    out[..., shared] = -found[..., p : p + s]
    out[..., own] = -found[..., p + s + n * track : p + s + n * (track + 1)]
    return out


def offers(table: Table, model: Model, columns: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Nats (K, B) on each fold of the model with one more of `columns` (K,) free, whose coefficient has `precision` (K,) about
    none: `judge` for each, with the nuisances that are at their bounds left there."""
    wide = widened(model, columns, precision)
    added = len(model.free) + np.arange(len(columns))
    nats = np.zeros((len(columns), len(table.white)))
    tracks = np.unique(table.track_of)
    for fold in range(len(table.folds[0])):
        hessian, push = _equations(table, wide, fold)
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
        for each in whole:
            _own_again(table, wide, each, table.folds[1][fold])
        blocks = np.flatnonzero(table.fold_of == fold)
        u = _spread(table, wide, whole, int(np.searchsorted(tracks, table.track_of[blocks[0]])))
        for b in blocks:
            nats[:, b] = -0.5 * ((u @ table.white[b]) * u).sum(1)
    return nats


def widened(model: Model, columns: np.ndarray, precision: np.ndarray) -> Model:
    """The model with further columns free, whose coefficients have `precision` about none."""
    size, more = len(model.free), len(columns)
    block = np.zeros((size + more, size + more))
    block[:size, :size] = model.precision
    block[np.arange(size, size + more), np.arange(size, size + more)] = precision
    free = np.concatenate([model.free, columns]).astype(int)
    return Model(model.parts, free, np.concatenate([model.mean, np.zeros(more)]), block, model.bound)


def judge(table: Table, model: Model) -> Judged:
    """The model on each fold, fitted to all others."""
    nats, squares = np.zeros(len(table.white)), np.zeros((len(table.white), 6))
    taken = []
    for fold in range(len(table.folds[0])):
        coefficients = solve(table, model, fold)
        blocks = np.flatnonzero(table.fold_of == fold)
        u = coefficients[table.track_of[blocks[0]]]
        nats[blocks] = -0.5 * np.einsum("c,bcd,d->b", u, table.white[blocks], u)
        squares[blocks] = np.einsum("c,bkcd,d->bk", u, table.error[blocks], u)
        taken.append(-u[table.nuisances[table.shared]])
    return Judged(nats, squares, np.array(taken))


def keep(table: Table, model: Model, drop=(), off: np.ndarray | None = None) -> np.ndarray:
    """Squared errors (B, 6) on each fold of a model fitted to all others, once the effects `drop` and the nuisances `off`
    (N,) go and everything else stays as fitted."""
    squares = np.zeros((len(table.white), 6))
    for fold in range(len(table.folds[0])):
        blocks = np.flatnonzero(table.fold_of == fold)
        u = solve(table, model, fold)[table.track_of[blocks[0]]]
        for effect in drop:
            others = {int(i) for e in table.fit.effects if e not in drop for i in prior((e,))[0]}
            own = [table.derivative[int(i)] for i in prior((effect,))[0] if int(i) not in others]
            u[own] = 0.0
            u[table.part[effect]] = 1.0
        if off is not None:
            u[table.nuisances[off]] = 0.0
        squares[blocks] = np.einsum("c,bkcd,d->bk", u, table.error[blocks], u)
    return squares


def level(squares: np.ndarray, floor: np.ndarray) -> float:
    """The gap: rms over channels of each channel's error over its floor (6,), both sums over the same rows."""
    use = floor > 0
    return float(np.sqrt(np.mean(squares.sum(0)[use] / floor[use])))


__all__ = [
    "ERRORS",
    "PLACE",
    "Judged",
    "Model",
    "Table",
    "build",
    "judge",
    "level",
    "offers",
    "solve",
    "widened",
    "with_effects",
]
