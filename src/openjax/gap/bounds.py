"""Least squares with bounds: a nuisance may take twice its usual size, and one that wants more is a finding."""

from __future__ import annotations

import numpy as np

BOUND = 2.0  # usual sizes that a nuisance may take


def bounded(hessian, push, free: int = 0, bound: float = BOUND) -> tuple[np.ndarray, np.ndarray]:
    """Minimum of x'Hx/2 - push'x with |x| <= bound beyond the first `free` entries, by fixing what leaves the box; and
    which entries are inside it."""
    found = np.zeros(len(push))
    open_ = np.ones(len(push), bool)
    for _ in range(len(push)):
        inside = np.flatnonzero(open_)
        rest = push[inside] - hessian[np.ix_(inside, np.flatnonzero(~open_))] @ found[~open_]
        found[inside] = np.linalg.solve(hessian[np.ix_(inside, inside)], rest)
        beyond = open_ & (np.abs(found) > bound) & (np.arange(len(push)) >= free)
        if not beyond.any():
            break
        found[beyond] = np.sign(found[beyond]) * bound
        open_ &= ~beyond
    return found, open_


def held_objective(residuals, columns, nuisances, shared, off: np.ndarray, precision: np.ndarray) -> float:
    """Least half square of whitened residuals [(M,)] of every track, once columns [(p, M)] may move from where they are -
    `off` (p,) from a prior of `precision` - and nuisances [(N, M)] of unit prior variance may take what their bounds allow:
    those of `shared` (N,) the same on every track."""
    free, common, own = len(off), int(shared.sum()), int((~shared).sum())
    size = free + common + own * len(residuals)
    hessian, push, square = np.eye(size), np.zeros(size), 0.0
    hessian[:free, :free] = precision
    push[:free] = -precision @ off
    for k, (r, c, n) in enumerate(zip(residuals, columns, nuisances, strict=True)):
        x = np.concatenate([c, n[shared], n[~shared]])
        here = np.concatenate([np.arange(free + common), free + common + own * k + np.arange(own)])
        hessian[np.ix_(here, here)] += x @ x.T
        push[here] += x @ r
        square += float(r @ r)
    found, _ = bounded(hessian, push, free)
    return (
        0.5 * square
        + 0.5 * float(off @ precision @ off)
        - float(push @ found - 0.5 * found @ hessian @ found)
    )
