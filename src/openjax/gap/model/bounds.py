"""Least squares with bounds: a nuisance may take twice its usual size, and one that
wants more is a finding.
"""

import numpy as np
from jaxtyping import Float

from openjax.gap.decision import DECISION

# tries in which no fewer entries are wrong, after which they are let go one by one
PATIENCE = 4


def solve_bounded(
    hessian: Float[np.ndarray, "entries entries"],
    push: Float[np.ndarray, " entries"],
    free: int = 0,
) -> Float[np.ndarray, " entries"]:
    """Minimum of x'Hx/2 - push'x with |x| within the bound of nuisances beyond the first
    `free` entries, H positive definite.

    Block principal pivoting (Judice, Pires 1994): entries that leave the box are fixed
    at its edge and those that would come back are let go, all at once as long as fewer
    are wrong each time, else the last of them alone, so that it ends.
    """
    limit = np.full(len(push), DECISION.nuisance_bound)
    limit[:free] = np.inf
    side = np.zeros(len(push))
    fewest = len(push) + 1
    patience = PATIENCE
    while True:
        solution = np.where(side == 0.0, 0.0, side * DECISION.nuisance_bound)
        inside = np.flatnonzero(side == 0.0)
        at_bound = np.flatnonzero(side)
        right = push[inside] - hessian[np.ix_(inside, at_bound)] @ solution[at_bound]
        solution[inside] = np.linalg.solve(hessian[np.ix_(inside, inside)], right)
        # positive: back into the box is downhill
        pull = side * (hessian @ solution - push)
        beyond = np.abs(solution) > limit * (1.0 + 1e-9)
        back = pull > 1e-9 * np.abs(push)
        wrong = np.flatnonzero(beyond | back)
        if not len(wrong):
            return solution
        patience = PATIENCE if len(wrong) < fewest else patience - 1
        fewest = min(fewest, len(wrong))
        flips = wrong if patience > 0 else wrong[-1:]
        side[flips] = np.where(beyond[flips], np.sign(solution[flips]), 0.0)
