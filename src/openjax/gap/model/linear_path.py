"""Linear models of a log that need no physics, with their own coloured noise."""

from dataclasses import dataclass

import numpy as np

from openjax.gap.model.replay import marginal_gram
from openjax.gap.model.whitening import fit_noise, whiten

PASSES = 3  # of fitting the noise model and the coefficients in turn
START = 20  # rows at the start of a track that the noise model needs


@dataclass(frozen=True, eq=False)
class LinearPath:
    """y (T, A) = columns x theta + nuisances + noise, for each track; theta has a zero-mean prior of `spread` (P,).

    `gram` (1 + P, 1 + P): whitened inner products, nuisances marginalised; `before` and `residual` [(T, A)]: without the
    columns, all else as fitted, and after the fit."""

    gram: np.ndarray
    spread: np.ndarray
    before: list[np.ndarray]
    residual: list[np.ndarray]

    def score(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Log Bayes factor of the columns against their absence, coefficients (P,), covariance (P, P)."""
        hessian = self.gram[1:, 1:] + np.diag(1.0 / self.spread**2)
        theta = np.linalg.solve(hessian, self.gram[1:, 0])
        volume = np.linalg.slogdet(hessian)[1] + 2 * np.log(self.spread).sum()
        return float(0.5 * self.gram[1:, 0] @ theta - 0.5 * volume), theta, np.linalg.inv(hessian)


def fit_linear_path(y, columns, nuisances, spread, groups) -> LinearPath:
    """Fit tracks' y [(T, A)], columns [(P, T, A)], nuisances [(N, T, A)] (unit prior variance). groups: ((axes, integrated),
    ...) that share a noise model."""
    spread = np.asarray(spread, float)
    size = 1 + len(spread)
    data = [np.concatenate([a[None], b, c]) for a, b, c in zip(y, columns, nuisances, strict=True)]
    residual = [a - a.mean(0) for a in y]
    for _ in range(PASSES):
        noises = tuple(fit_noise(axes, residual, integrated, START) for axes, integrated in groups)
        white = [whiten(noises, d)[:, START:].reshape(len(d), -1) for d in data]
        gram = sum(marginal_gram(w[:size], w[size:]) for w in white)
        theta = LinearPath(gram, spread, [], []).score()[1]
        residual = [_left(d, w, theta) for d, w in zip(data, white, strict=True)]
    # Nuisances stay as they are beside the columns: set free, a clock of a few ms would take any delay.
    before = [r + np.tensordot(theta, d[1:size], 1) for r, d in zip(residual, data, strict=True)]
    return LinearPath(gram, spread, before, residual)


def _left(d: np.ndarray, w: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Residual (T, A) of one track's data d with coefficients theta, less the nuisances' most likely part."""
    size = 1 + len(theta)
    left, n = w[0] - theta @ w[1:size], w[size:]
    taken = np.linalg.solve(np.eye(len(n)) + n @ n.T, n @ left)
    return d[0] - np.tensordot(theta, d[1:size], 1) - np.tensordot(taken, d[size:], 1)
