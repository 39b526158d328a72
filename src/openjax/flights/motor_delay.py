"""True if motors are quick or slow, or their commands on another clock: lag and delay told apart.

Both turn the phase of the answer, and only a lag bends its gain, too. In closed loop gusts turn the
body and motors answer them, so that phases and gains of spectra are biased; errors of a prediction
one row ahead aren't (Ljung, System Identification, 13.4). For each of some lags and delays the
row's change of the body rates is predicted by the torques that the motors make in it, with an
autoregression for what else turns the body.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

LAGS = np.geomspace(0.001, 0.3, 20)  # s
FINER = 4  # steps of a delay in a row
EDGE = 0.3  # s at either end, where what motors did before isn't known
ORDER = 10  # rows of the autoregression
PASSES = 3  # of errors and their autoregression in turn
FEWEST = 100  # rows
LONGEST = 20.0  # s of a flight, and MOST flights: enough to tell
MOST = 12


@dataclass(frozen=True, eq=False)
class LagAndDelay:
    """The likelihood of flights under each of `delays` (D,), s, with the best lag for each."""

    delays: np.ndarray
    nats: np.ndarray

    @property
    def delay(self) -> float:
        """The likeliest, s."""
        return float(self.delays[np.argmax(self.nats)])

    def against(self, earliest: float, latest: float) -> float:
        """Nats by which the likeliest delay beats all between these, s."""
        inside = (self.delays >= earliest) & (self.delays <= latest)
        return float(self.nats.max() - self.nats[inside].max()) if inside.any() else np.inf


def lag_and_delay(
    flights: Sequence[tuple[np.ndarray, np.ndarray]], place: np.ndarray, dt: float, reach: float
) -> LagAndDelay | None:
    """The likelihood of delays up to `reach` s either way, of flights' body rates (T, 3),
    rad/s, and motor commands (T, 4), each held over its row of `dt` s. `place` (4, 3): of
    the rotors, m. None where flights are too short.
    """
    rows = int(LONGEST / dt)
    flights = [(r[:rows], m[:rows]) for r, m in flights if len(r) > 2 * int(EDGE / dt) + FEWEST]
    if not flights:
        return None
    flights = flights[:: -(-len(flights) // MOST)]
    steps = np.arange(-round(reach / dt * FINER), round(reach / dt * FINER) + 1)
    inner = slice(int(EDGE / dt), -int(EDGE / dt))
    changes = [np.diff(r[:, :2], axis=0)[inner] for r, _ in flights]
    changes = [(c - c.mean(0)).T for c in changes]  # (2, T)

    def inputs(lag: float) -> list[np.ndarray]:
        torques = (
            _late_torques(m, place, lag, dt, steps)[..., :-1][..., inner] for _, m in flights
        )
        return [t - t.mean(-1, keepdims=True) for t in torques]  # (D, 2, T)

    whitening = np.ones((2, 1))
    for _ in range(PASSES):
        nats = np.stack([_nats(changes, inputs(lag), whitening) for lag in LAGS])  # (L, D)
        lag, delay = np.unravel_index(np.argmax(nats), nats.shape)
        best = [i[delay] for i in inputs(LAGS[lag])]
        gain = _gain(*_sums(changes, best))
        whitening = _whitening([c - gain[:, None] * i for c, i in zip(changes, best, strict=True)])
    return LagAndDelay(steps * dt / FINER, nats.max(0))


def row_torques(motor: np.ndarray, place: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Torques (T, 2) in roll and pitch, but for their unit, that motors make in each row through
    their lag: the mean over the row of a first-order answer to a command that is held.
    """
    decay = np.exp(-dt / lag)
    response = lfilter([1.0 - decay], [1.0, -decay], motor, axis=0, zi=decay * motor[:1])[0]
    response_before = np.concatenate([motor[:1], response[:-1]])
    means = motor + (response_before - motor) * (1.0 - decay) * lag / dt
    # Rotors that differ need unequal commands whenever the thrust changes, and no torque
    # acts: what goes with the sum tells no time, and in a climb it is all there is.
    total = means.sum(1)
    columns = np.stack([np.ones_like(total), total], 1)
    torques = means @ np.stack([place[:, 1], -place[:, 0]], 1)
    return torques - columns @ np.linalg.lstsq(columns, torques, rcond=None)[0]


def _late_torques(motor, place, lag: float, dt: float, steps: np.ndarray) -> np.ndarray:
    """(D, 2, T) the same, of commands that act some `steps` of a row / FINER later."""
    fine = row_torques(np.repeat(motor, FINER, axis=0), place, lag, dt / FINER)
    rows = np.clip(np.arange(len(fine)) - steps[:, None], 0, len(fine) - 1)
    means = fine[rows].reshape(len(steps), len(motor), FINER, 2).mean(2)
    return np.moveaxis(means, 2, 1)


def _nats(changes: list[np.ndarray], inputs: list[np.ndarray], whitening) -> np.ndarray:
    """(D,) log-likelihoods of changes (2, T) by inputs (D, 2, T), whitened (2, N)."""
    white_changes = [_white(c, whitening) for c in changes]
    products, powers = _sums(white_changes, [_white(i, whitening) for i in inputs])
    total = sum((c * c).sum(-1) for c in white_changes)
    rest = total - _gain(products, powers) * products
    rows = sum(c.shape[-1] for c in white_changes)
    return -0.5 * rows * np.log(np.maximum(rest, 1e-30)).sum(-1)


def _sums(changes: list[np.ndarray], inputs: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Products of changes (2, T) with inputs (..., 2, T) and powers of these, (..., 2)."""
    products = sum((i * c).sum(-1) for c, i in zip(changes, inputs, strict=True))
    return products, sum((i * i).sum(-1) for i in inputs)


def _gain(products: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """(..., 2) of least squares; motors don't turn a body the other way."""
    return np.maximum(products / np.maximum(powers, 1e-30), 0.0)


def _white(values: np.ndarray, whitening: np.ndarray) -> np.ndarray:
    """Values (..., 2, T) through each axis' filter, without where it begins."""
    axes = [lfilter(whitening[k], 1.0, values[..., k, :], axis=-1) for k in range(2)]
    return np.stack(axes, -2)[..., ORDER:]


def _whitening(errors: list[np.ndarray]) -> np.ndarray:
    """The filters (2, ORDER + 1) that leave nothing of errors (2, T) that those before tell."""
    filters = []
    for k in range(2):
        axis = [e[k] for e in errors]
        lags = range(ORDER + 1)
        products = np.array([sum((e[: len(e) - n] * e[n:]).sum() for e in axis) for n in lags])
        products[0] = products[0] * (1.0 + 1e-9) + 1e-30
        filters.append([1.0, *-solve_toeplitz(products[:-1], products[1:])])
    return np.array(filters)
