"""Paths of a log that need no physics: firmware and estimator, each linear in what is asked of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.gap.replay import marginal_gram
from openjax.gap.whitening import Noise, fit_noise, whiten

PASSES = 3  # of fitting the noise model and the coefficients in turn


@dataclass(frozen=True, eq=False)
class LinearPath:
    """y (T, A) = columns x theta + nuisances + noise, for each track; theta has a zero-mean prior of
    `spread` (P,)."""

    grams: np.ndarray  # (F, 1 + P, 1 + P) whitened inner products per flight, nuisances marginalised
    spread: np.ndarray  # (P,)
    before: list[np.ndarray]  # (T, A) residuals without the effect, all else as fitted
    residual: list[np.ndarray]  # (T, A) residuals after the fit
    noises: tuple[Noise, ...]
    rows: int  # residuals that counted

    def score(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Log Bayes factor of the path's effect against its absence, coefficients (P,), covariance (P, P)."""
        return linear_score(self.grams.sum(0), self.spread)


def linear_score(gram: np.ndarray, spread: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Log Bayes factor, coefficients and covariance from a gram matrix (1 + P, 1 + P), residual first."""
    precision = np.diag(1.0 / spread**2)
    hessian = gram[1:, 1:] + precision
    theta = np.linalg.solve(hessian, gram[1:, 0])
    volume = np.linalg.slogdet(hessian)[1] + 2 * np.log(spread).sum()
    return float(0.5 * gram[1:, 0] @ theta - 0.5 * volume), theta, np.linalg.inv(hessian)


def fit_linear_path(
    y, columns, nuisances, flight_of, spread, groups, masks=None, tolerance=None, noise=None, skip: int = 20
):
    """Fit tracks' y [(T, A)], columns [(P, T, A)], nuisances [(N, T, A)] (unit prior variance).

    groups: ((axes, integrated), ...) that share a noise model; masks [(T,)] are 0 in rows that must not
    count. tolerance (P,): share of each coefficient by which it may be off without a cause, per flight; noise [(P, T, A)]:
    a draw of what noise does to the columns, which pulls a coefficient down by its share of the column's power (errors in
    variables), so calm flights say little."""
    spread = np.asarray(spread, float)
    size = 1 + len(spread)
    flights = int(np.max(flight_of)) + 1
    data = [np.concatenate([a[None], b, c]) for a, b, c in zip(y, columns, nuisances, strict=True)]
    residual = [a - a.mean(0) for a in y]
    for _ in range(PASSES):
        noises = tuple(fit_noise(axes, residual, integrated, masks, skip) for axes, integrated in groups)
        grams, whitened, rows = np.zeros((flights, size, size)), [], 0
        for number, d in enumerate(data):
            w = whiten(noises, d)[:, skip:]
            if masks is not None:
                w = w * masks[number][skip:, None]
            rows += int(w.shape[1] if masks is None else masks[number][skip:].sum()) * w.shape[2]
            w = w.reshape(len(w), -1)
            if tolerance is not None:
                shares = np.array(tolerance)
                if noise is not None:
                    n = whiten(noises, noise[number])[:, skip:]
                    n = n * (1.0 if masks is None else masks[number][skip:, None])
                    shares = np.maximum(
                        shares, (n**2).sum((1, 2)) / np.maximum((w[1:size] ** 2).sum(1), 1e-12)
                    )
                w = np.concatenate([w, w[1:size] * shares[:, None]])
            whitened.append(w)
            grams[flight_of[number]] += marginal_gram(whitened[-1][:size], whitened[-1][size:])
        _, theta, _ = linear_score(grams.sum(0), spread)
        residual = [_left(d, w, theta) for d, w in zip(data, whitened, strict=True)]
    # Nuisances stay as they are beside the effect: set free, a clock of a few ms would take any delay.
    before = [r + np.tensordot(theta, d[1:size], 1) for r, d in zip(residual, data, strict=True)]
    return LinearPath(grams, spread, before, residual, noises, rows)


def _left(d: np.ndarray, w: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Residual (T, A) of one track's data d with coefficients theta, less the nuisances' most likely part."""
    size = 1 + len(theta)
    left, n = w[0] - theta @ w[1:size], w[size:]
    taken = np.linalg.solve(np.eye(len(n)) + n @ n.T, n @ left)[: len(d) - size]
    return d[0] - np.tensordot(theta, d[1:size], 1) - np.tensordot(taken, d[size:], 1)
