"""Everything that a set of effects could still become, as small matrices: the case
linearised around a fitted set.

A table holds, for every second of flight, inner products of all whitened columns that a
decision may combine: what is left, its derivatives with respect to every parameter, what
each further effect would do as it was fitted alone, what each effect of the set does, and
the nuisances. Beside them stand the errors of short predictions that the columns make
(gap). So adding, dropping and swapping effects on stretches left out costs nothing but
linear algebra.

Nuisances of the vehicle and its sensors are shared by all flights of the case and
bounded: each stays within twice its usual size, and one that ends there is a finding.
How strong feedback is depends on what the vehicle does, block by block.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.gap.model.blocks import block_diagonal
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import CARDS, places
from openjax.gap.model.replay import FORCE, SKIP, block_count

# s of the predictions whose errors are the gap; "acceleration" is the velocity that the
# accelerometer says
HORIZONS = {"rates": 0.05, "velocity": 0.25, "acceleration": 0.25}
ERRORS = tuple(f"{kind} {axis}" for kind in HORIZONS for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Table:
    """Inner products of C columns in each of B blocks. Column 0 is what is left; then
    come derivatives, steps and parts; the last are nuisances.
    """

    fit: SetFit
    white: np.ndarray
    """(B, C, C) of the whitened columns: the likelihood."""
    errors: list
    """[(C, T, logged of ERRORS)]: errors of short predictions in each block: the gap."""
    rows: np.ndarray
    """(B,) rows that count."""
    track_of: np.ndarray
    """(B,) whose a block is."""
    derivative: dict[int, int]
    """{place in theta: column of the derivative by it}."""
    step: dict[str, int]
    """{effect that may come in: column of what it does as it was fitted alone}."""
    part: dict[str, int]
    """{effect of the set: column of what it does}."""
    is_shared: np.ndarray
    """(N,) whether a nuisance is the case's; the others are a block's."""
    columns: list
    """[(C, M)]: whitened columns of each block."""

    @property
    def size(self) -> int:
        """C."""
        return self.white.shape[1]

    @property
    def nuisances(self) -> np.ndarray:
        """(N,) columns of the nuisances."""
        return np.arange(self.size - len(self.is_shared), self.size)

    @property
    def block_nuisances(self) -> np.ndarray:
        """Columns of the nuisances that belong to a block."""
        return self.nuisances[~self.is_shared]

    @cached_property
    def projection(self) -> np.ndarray:
        """(B, own, C): what each column has of a block's own nuisances, of unit prior
        variance.
        """
        inside = self.white[:, self.block_nuisances][:, :, self.block_nuisances]
        return np.linalg.solve(
            inside + np.eye(len(self.block_nuisances)), self.white[:, self.block_nuisances]
        )

    @cached_property
    def total(self) -> np.ndarray:
        """(C, C): `marginal` of all blocks together."""
        return self.marginal.sum(0)

    @cached_property
    def fully_marginal(self) -> np.ndarray:
        """(C, C): `total` with the shared nuisances marginalised as well."""
        case_nuisances = self.nuisances[self.is_shared]
        inside = self.total[np.ix_(case_nuisances, case_nuisances)] + np.eye(len(case_nuisances))
        return self.total - self.total[:, case_nuisances] @ np.linalg.solve(
            inside, self.total[case_nuisances]
        )

    @cached_property
    def marginal(self) -> np.ndarray:
        """`white` with a block's own nuisances marginalised (Frisch, Waugh, Lovell)."""
        return self.white - self.white[:, :, self.block_nuisances] @ self.projection


@dataclass(frozen=True, eq=False)
class Model:
    """One combination of a table's columns: column 0 and `parts` are there, the
    coefficients of `free` are fitted, with prior `mean` and `precision`.
    """

    parts: tuple[int, ...]
    free: np.ndarray
    mean: np.ndarray
    precision: np.ndarray


def build(fit: SetFit, singles: dict[str, SetFit] | None) -> Table:
    """The table around a fitted set; `singles` {effect: its fit alone} are the effects
    that may come in; None: nothing may come in or go.
    """
    replay = fit.replay
    within = fit.effects if singles is not None else ()
    others = [e for e in singles or () if e not in within]
    index = np.concatenate([fit.index, places(others)])
    points = []
    for effect in others:
        theta = fit.theta.copy()
        theta[places((effect,))] = singles[effect].theta[places((effect,))]
        points.append(replay.alone((*within, effect), theta))
    points += [replay.alone([e for e in within if e != effect], fit.theta) for effect in within]
    columns = fit.columns if singles is None else replay.linearise(fit.theta, index)
    predictions = [np.zeros((0, *y.shape)) for y in replay.measurements]
    if points:
        predictions = replay.predict(np.array(points))
    white = []
    errors = []
    rows = []
    track_of = []
    whole = []
    for number, (c, m, track) in enumerate(zip(columns, predictions, replay.tracks, strict=True)):
        residual = replay.measurements[number] - c[0]
        nuisances = replay.nuisances[number]
        x = np.concatenate([c, m[: len(others)] - residual, residual - m[len(others) :], nuisances])
        without = replay.whiten(x[: -len(nuisances)], number)
        w = np.concatenate([without, replay.whitened_nuisances[number]])
        count = block_count(w.shape[1], track.dt)
        # of the longest predictions, a quarter of a second, the first ends at row 25
        e = _errors(x, track.dt)[:, max(int(SKIP / track.dt), 25) :, replay.usable > 0]
        for a, b in zip(np.array_split(w, count, 1), np.array_split(e, count, 1), strict=True):
            flat = a.reshape(len(x), -1)
            whole.append(flat)
            white.append(flat @ flat.T)
            errors.append(b)
            rows.append(b.shape[1])
            track_of.append(number)
    first_step = 1 + len(index)
    first_part = first_step + len(others)
    return Table(
        fit=fit,
        white=np.array(white),
        errors=errors,
        rows=np.array(rows),
        track_of=np.array(track_of),
        derivative={int(i): 1 + k for k, i in enumerate(index)},
        step={e: first_step + k for k, e in enumerate(others)},
        part={e: first_part + k for k, e in enumerate(within)},
        is_shared=replay.is_shared,
        columns=whole,
    )


def _errors(x: np.ndarray, dt: float) -> np.ndarray:
    """Errors (C, T, 9) of predictions over HORIZONS that end at each row."""
    out = np.zeros_like(x)
    for k, horizon in enumerate(HORIZONS.values()):
        axes = slice(3 * k, 3 * k + 3)
        step = max(round(horizon / dt), 1)
        whole = np.cumsum(x[..., axes], axis=1) * dt if axes == FORCE else x[..., axes]
        out[:, step:, axes] = whole[:, step:] - whole[:, :-step]
    return out


def with_effects(table: Table, add=(), drop=()) -> Model:
    """The table's set with effects that come in as they were fitted alone (and may move
    from there) or go.
    """
    remaining = tuple(e for e in table.fit.effects if e not in drop)
    index, mean, precision = table.fit.replay.prior(remaining)
    derivatives_of_set = np.array([table.derivative[int(i)] for i in index], int)
    # The set's parameters: coefficients count from where they were fitted.
    mean = mean - table.fit.theta[index] if len(index) else mean
    free = [derivatives_of_set]
    means = [mean]
    blocks = [precision]
    for effect in add:
        if effect in table.step:
            free.append(np.array([table.step[effect]]))
            means.append(np.array([0.0]))
            blocks.append(np.eye(1))
        place = places((effect,))
        spread = np.array([p.spread for p in CARDS[effect].fitted])
        spread = spread * table.fit.replay.size_factors[place]
        derivatives = [table.derivative[int(i)] for i in place]
        inside = [k for k, column in enumerate(derivatives) if column not in derivatives_of_set]
        free.append(np.array([derivatives[k] for k in inside], int))
        means.append(np.zeros(len(inside)))
        blocks.append(np.diag(1.0 / spread[inside] ** 2))
    free = np.concatenate(free).astype(int)
    return Model(
        tuple(table.part[e] for e in drop), free, np.concatenate(means), block_diagonal(blocks)
    )
