"""Noise models: what turns the residual of a channel into (nearly) independent numbers of unit variance.

Integrated channels (rates, velocity, attitude) wander: their residual is a random walk from disturbances plus white
sensor noise. A stationary Kalman filter of that pair, s -> s - prediction, is one first-order high-pass; what is left
of colour is taken out by an autoregression. Both act on residuals and on their derivatives alike, and causally, so
that a residual is only ever explained by what came before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

GAINS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
ORDER = 12


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of one group of axes: Kalman gain (None: not integrated), autoregression (p,), innovation's deviation."""

    axes: tuple[int, ...]
    gain: float | None
    regression: np.ndarray
    deviation: float

    def high_pass(self, x: np.ndarray) -> np.ndarray:
        """Innovations of x (..., T, axes) before the autoregression."""
        return x if self.gain is None else lfilter([1.0, -1.0], [1.0, self.gain - 1.0], x, axis=-2)

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """x (..., T, axes) in units of the innovation's standard deviation."""
        numerator, denominator = np.r_[1.0, -self.regression], [1.0, 0.0]
        if self.gain is not None:
            numerator, denominator = np.convolve([1.0, -1.0], numerator), [1.0, self.gain - 1.0]
        return lfilter(numerator / self.deviation, denominator, x, axis=-2)


def whiten(noises, x: np.ndarray) -> np.ndarray:
    """x (..., T, C) channel by channel, each group of axes by its own noise model."""
    out = np.empty_like(x)
    for noise in noises:
        axes = list(noise.axes)
        out[..., axes] = noise.whiten(x[..., axes])
    return out


def fit_noise(axes, residuals, integrated: bool, masks=None, skip: int = 20) -> Noise:
    """Noise model of residuals [(T, C), ...], pooled over tracks and `axes`; rows where a mask is 0 don't count."""
    best = None
    for gain in GAINS if integrated else (None,):
        filtered = Noise(tuple(axes), gain, np.zeros(0), 1.0)
        series = []
        for number, residual in enumerate(residuals):
            z = filtered.high_pass(residual[:, list(axes)])
            if masks is not None:
                z = z * masks[number][:, None]
            series += list(z[skip:].T)
        regression, deviation = _autoregression(series)
        if best is None or deviation < best.deviation:
            best = Noise(tuple(axes), gain, regression, deviation)
    return best


def _autoregression(series) -> tuple[np.ndarray, float]:
    """Yule-Walker on pooled series: coefficients (ORDER,) and the innovation's deviation."""
    lags = np.zeros(ORDER + 1)
    for z in series:
        for k in range(ORDER + 1):
            lags[k] += z[k:] @ z[: len(z) - k]
    lags /= max(sum(len(z) for z in series), 1)
    if lags[0] <= 0:
        return np.zeros(ORDER), 1e-9
    lags[0] *= 1 + 1e-6
    coefficients = solve_toeplitz(lags[:-1], lags[1:])
    return coefficients, float(np.sqrt(max(lags[0] - coefficients @ lags[1:], 1e-18)))
