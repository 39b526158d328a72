"""Noise models: what turns the residual of a channel into (nearly) independent numbers
of unit variance.

A residual is sensor noise and gusts. Sensor noise is white; a gust is a force or torque
with a memory of some time, which integrated channels (rates, velocity, attitude) add
up, beside small white steps from what the replay leaves out. The innovations of the
Kalman filter of this model are white. Everything acts on residuals and on their
derivatives alike, and causally: in closed loop the motors answer disturbances, so only
a residual given its own past says something about causes.
"""

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

# The grid of models: memory of the gust (per row), its rms per row and that of the
# white steps over sensor noise.
MEMORIES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.995)
GUSTS = (0.003, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3, 0.6, 1.5)
STEPS = (0.0, 0.05, 0.15, 0.4, 1.0)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of one group of axes: whitening filter (numerator, denominator),
    innovation's deviation.
    """

    axes: tuple[int, ...]
    numerator: np.ndarray
    denominator: np.ndarray
    deviation: float

    def whiten(
        self, x: Float[np.ndarray, "*sets rows axes"]
    ) -> Float[np.ndarray, "*sets later axes"]:
        """x (..., T, axes) in units of the innovation's standard deviation."""
        return lfilter(self.numerator / self.deviation, self.denominator, x, axis=-2)


def whiten(
    noises, x: Float[np.ndarray, "*sets rows channels"]
) -> Float[np.ndarray, "*sets later channels"]:
    """x (..., T, C) channel by channel, each group of axes, which lie side by side, by
    its own noise model.
    """
    out = np.empty_like(x)
    for noise in noises:
        axes = slice(noise.axes[0], noise.axes[-1] + 1)
        out[..., axes] = noise.whiten(x[..., axes])
    return out


def first_noise(axes, integrates: bool, deviation: float) -> Noise:
    """A noise model to begin with: sensor noise and some white steps."""
    step = 0.15 if integrates else 0.0
    numerator, denominator = _kalman(memory=0.9, gust=0.04, step=step, integrates=integrates)
    return Noise(tuple(axes), numerator, denominator, deviation)


def fit_noise(axes, residuals, integrates: bool, skip: int = 20) -> Noise:
    """Noise model of residuals [(T, C), ...], pooled over tracks and `axes`.

    The model of the grid is chosen by Whittle's likelihood."""
    series = [r[:, list(axes)] for r in residuals]
    memory, gust, step = _choose([s[skip:] for s in series], integrates)
    numerator, denominator = _kalman(memory, gust, step, integrates)
    # the filter starts at the first row, and what it makes of its start is cut off
    # afterwards
    white = [lfilter(numerator, denominator, s, axis=0)[skip:].ravel() for s in series]
    deviation = float(np.sqrt(np.mean(np.concatenate(white) ** 2))) + 1e-9
    return Noise(tuple(axes), numerator, denominator, deviation)


def _choose(parts, integrates: bool) -> tuple[float, float, float]:
    """The grid's (memory, gust, step) with the largest Whittle likelihood, its scale
    profiled out.
    """
    log_part = 0.0
    ratio_part = 0.0
    count = 0
    for part in parts:
        # differences of what adds up are stationary, as Whittle's likelihood asks for
        z = np.diff(part, axis=0) if integrates else part
        taper = np.hanning(len(z))[:, None]
        power = np.abs(np.fft.rfft((z - z.mean(0)) * taper, axis=0)) ** 2
        # without the two lowest frequencies, into which the taper smears the mean
        periodogram = power.sum(1)[2:] / (taper**2).sum()
        spectra, logs = _spectra(len(z), integrates)
        ratio_part = ratio_part + (periodogram / spectra).sum(1)
        log_part = log_part + z.shape[1] * logs
        count += len(periodogram) * z.shape[1]
    likelihood = -log_part - count * np.log(ratio_part / count)
    return _grid(integrates)[int(np.argmax(likelihood))]


@lru_cache(maxsize=2)
def _grid(integrates: bool) -> list[tuple[float, float, float]]:
    return list(itertools.product(MEMORIES, GUSTS, STEPS if integrates else (0.0,)))


@lru_cache(maxsize=32)
def _spectra(rows: int, integrates: bool) -> tuple[np.ndarray, np.ndarray]:
    """Model spectra (G, f) of (differenced) residuals of unit sensor noise, and the
    sums of their logarithms (G,).
    """
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(rows)[2:])
    grid = np.array(_grid(integrates))
    memory, gust, step = (grid[:, k, None] for k in range(3))
    spectra = gust**2 * (1 - memory**2) / np.abs(1 - memory * shift) ** 2 + step**2
    spectra = spectra + (np.abs(1 - shift) ** 2 if integrates else 1.0)
    return spectra, np.log(spectra).sum(1)


@lru_cache(maxsize=1024)
def _kalman(
    memory: float, gust: float, step: float, integrates: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Innovation filter (numerator, denominator) of the stationary Kalman filter with
    unit sensor noise.
    """
    drive = gust**2 * (1 - memory**2)
    if integrates:
        a = np.array([[1.0, 1.0], [0.0, memory]])
        # a filter that nothing drives would have no stationary gain
        q = np.diag([step**2 + 1e-9, drive])
        c = np.array([[1.0, 0.0]])
    else:
        a = np.array([[memory]])
        q = np.array([[drive + 1e-9]])
        c = np.array([[1.0]])
    variance = solve_discrete_are(a.T, c.T, q, np.eye(1))
    gain = a @ variance @ c.T / (c @ variance @ c.T + 1.0)
    return np.poly(a), np.poly(a - gain @ c)
