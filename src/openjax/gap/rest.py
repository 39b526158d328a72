"""What a hypothesis leaves: is it noise and gusts, or something that no effect of the library explains?

Three looks at the rest of the best hypothesis, none of which knows the effects: how strong it is by
frequency band against the sensors' own noise, how much of it a flexible model of the state predicts on
flights that it wasn't fitted to, and how unevenly it comes. Each is a number per channel; the tuning turns
them into a probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track, rotation, smooth
from openjax.gap.hypotheses import SetFit, without_nuisances
from openjax.gap.replay import FORCE, RATES, SKIP, VELOCITY, Replay

BANDS = ((0.3, 1.5), (1.5, 5.0), (5.0, 12.0))  # Hz
SENSOR_BAND = (25.0, 45.0)  # Hz, where the logs hold sensor noise only
CHANNELS = ("torque_xy", "torque_z", "force_xy", "force_z", "accelerometer_xy", "accelerometer_z")
AXES = ((0, 1), (2,), (3, 4), (5,), (6, 7), (8,))
RIDGE = 30.0  # prior precision of the flexible model's standardised coefficients, per second of flight
BLOCK = 0.5  # s


@dataclass(frozen=True, eq=False)
class Rest:
    """`bands` (6, 3): log power by channel and band over sensor noise, `levels` the same as densities;
    `explained` (6,): share of the rest's power that the flexible model predicts on held-out flights;
    `uneven` (6,): log ratio of the largest to the median power of half-second blocks; `incoherent`:
    disagreement of the flights about the parameters, per parameter; `drivers` {channel: names of the
    regressors that carry most}."""

    bands: np.ndarray
    levels: np.ndarray
    explained: np.ndarray
    uneven: np.ndarray
    incoherent: float
    drivers: dict[str, list[str]]

    def vector(self) -> np.ndarray:
        return np.concatenate(
            [self.bands.ravel(), self.explained, self.uneven, [self.incoherent], self.levels.ravel()]
        )


def residuals_of(replay: Replay, fit: SetFit) -> list[np.ndarray]:
    """Residual (T, 9) of each track under a fit, nuisances taken off."""
    return [without_nuisances(replay, column[0], number) for number, column in enumerate(fit.columns)]


def disturbances(track: Track, residual: np.ndarray) -> np.ndarray:
    """The rest as accelerations (T, 9): angular (body), linear (body, from the velocity), specific force
    (body)."""
    out = np.zeros_like(residual)
    out[:, RATES] = np.gradient(residual[:, RATES], track.dt, axis=0)
    world = np.gradient(residual[:, VELOCITY], track.dt, axis=0)
    turn = (
        rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (len(track), 1, 1))
    )
    out[:, VELOCITY] = np.einsum("tji,tj->ti", turn, world)
    out[:, FORCE] = residual[:, FORCE]
    return out


def look(replay: Replay, fit: SetFit) -> Rest:
    """All three looks at what `fit` leaves."""
    residuals = residuals_of(replay, fit)
    rests = [disturbances(t, r) for t, r in zip(replay.tracks, residuals, strict=True)]
    bands, levels = np.mean([_bands(t, r) for t, r in zip(replay.tracks, rests, strict=True)], 0)
    calm = [smooth(r, 0.15, t.dt) for t, r in zip(replay.tracks, rests, strict=True)]
    explained, drivers = _explained(replay, calm)
    uneven = np.max([_uneven(t, r) for t, r in zip(replay.tracks, calm, strict=True)], 0)
    return Rest(bands, levels, explained, uneven, _incoherent(fit), drivers)


def _bands(track: Track, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log10 power density (6, 3) in the bands over that of the sensors, each as the sensor sees it."""
    rows = rest[int(SKIP / track.dt) :]
    window = np.hanning(len(rows))[:, None]
    power = np.abs(np.fft.rfft((rows - rows.mean(0)) * window, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(rows), track.dt)
    out, levels = np.zeros((len(AXES), len(BANDS))), np.zeros((len(AXES), len(BANDS)))
    density = track.dt / (window**2).sum()
    for number, axes in enumerate(AXES):
        spectrum = power[:, list(axes)].mean(1)
        top = (frequency > SENSOR_BAND[0]) & (frequency < SENSOR_BAND[1])
        if not top.any():
            top = frequency > 0.6 * frequency[-1]
        level = spectrum[top].mean() + 1e-20
        for band, (low, high) in enumerate(BANDS):
            inside = (frequency > low) & (frequency <= high)
            out[number, band] = np.log10((spectrum[inside].mean() + 1e-20) / level)
            levels[number, band] = np.log10(spectrum[inside].mean() * density + 1e-20)
    return out, levels


def regressors(track: Track) -> tuple[list[str], np.ndarray]:
    """A broad dictionary (T, K) of the state: velocity, attitude, rates, height, place, motors, voltage,
    time."""
    rows = len(track)
    zero = np.zeros((rows, 3))
    velocity = track.velocity if track.velocity is not None else zero
    turn = rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (rows, 1, 1))
    body = np.einsum("tji,tj->ti", turn, velocity)
    rates = smooth(track.body_rates, 0.05, track.dt)
    collective = smooth(track.motor.mean(1), 0.05, track.dt)
    columns = {}
    for axis, name in enumerate("xyz"):
        columns[f"v_{name}"] = body[:, axis]
        columns[f"v_{name}|v|"] = body[:, axis] * np.linalg.norm(body, axis=1)
        columns[f"F v_{name}"] = body[:, axis] * (collective - collective.mean())
        columns[f"w_{name}"] = rates[:, axis]
        columns[f"dw_{name}"] = np.gradient(rates[:, axis], track.dt)
        for other, label in ((0, "x"), (1, "y")):
            columns[f"world {label} in {name}"] = turn[:, other, axis]
        columns[f"up in {name}"] = turn[:, 2, axis]
    columns |= {
        "v_xy^2": (body[:, :2] ** 2).sum(1),
        "v_z^2": body[:, 2] ** 2,
        "sink": np.minimum(body[:, 2], 0.0),
        "w_x w_y": rates[:, 0] * rates[:, 1],
        "w_x w_z": rates[:, 0] * rates[:, 2],
        "w_y w_z": rates[:, 1] * rates[:, 2],
        "F": collective,
        "F^2": collective**2,
        "F^3": collective**3,
        "dF/dt": np.gradient(collective, track.dt),
        "high F": np.maximum(collective - np.quantile(collective, 0.8), 0.0),
    }
    mix = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0
    for name, row in zip(("roll", "pitch", "yaw"), mix, strict=True):
        difference = smooth(track.motor @ row, 0.03, track.dt)
        columns[f"{name} motors"] = difference
        columns[f"F x {name} motors"] = difference * (collective - collective.mean())
        columns[f"d {name} motors/dt"] = np.gradient(difference, track.dt)
    if track.position is not None:
        x, y, z = track.position.T
        radius = np.hypot(x, y) + 1e-6
        columns |= {
            "z": z,
            "near floor": (0.023 / (np.maximum(z, 0.0) + 0.03)) ** 2,
            "near ceiling": (0.023 / (np.maximum(1.2 - z, 0.0) + 0.05)) ** 2,
        }
        outward = np.stack([x, y, 0 * x], 1) * (np.maximum(radius - 0.5, 0.0) / radius)[:, None]
        for axis, name in enumerate("xyz"):
            columns[f"place in {name}"] = np.einsum(
                "tj,tj->t", track.position - track.position.mean(0), turn[:, :, axis]
            )
            columns[f"wall in {name}"] = np.einsum("tj,tj->t", outward, turn[:, :, axis])
        for k, other in enumerate(track.neighbours):
            gap = other - track.position
            below = (gap[:, 2] > 0.02) * np.exp(-gap[:, 2] / 0.5)
            for width in (0.05, 0.1, 0.2):
                columns[f"under {k} ({width})"] = below * np.exp(
                    -(gap[:, 0] ** 2 + gap[:, 1] ** 2) / (2 * width**2)
                )
    if track.voltage is not None:
        columns["V"] = track.voltage
    columns["t"] = track.time - track.time[0]
    names = list(columns)
    return names, smooth(np.stack([columns[n] for n in names], 1), 0.15, track.dt)


def _explained(replay: Replay, calm: list[np.ndarray]) -> tuple[np.ndarray, dict[str, list[str]]]:
    """Share of each channel's rest (6,) that ridge regression predicts on flights left out, at least 0."""
    tables = [regressors(t) for t in replay.tracks]
    shared = [n for n in tables[0][0] if all(n in names for names, _ in tables)]
    features = [values[:, [names.index(n) for n in shared]] for names, values in tables]
    skip = [int(SKIP / t.dt) for t in replay.tracks]
    stacked = np.concatenate([f[s:] for f, s in zip(features, skip, strict=True)])
    centre, scale = stacked.mean(0), stacked.std(0) + 1e-9
    x = [(f[s:] - centre) / scale for f, s in zip(features, skip, strict=True)]
    y = [c[s:] - c[s:].mean(0) for c, s in zip(calm, skip, strict=True)]
    count = len(replay.flights)
    share = np.zeros((len(AXES),))
    if count < 2:
        return share, {}
    spread = np.std(np.concatenate(y), 0) + 1e-12
    seconds = sum(len(t) * t.dt for t in replay.tracks)
    rows = sum(len(v) for v in x)
    penalty = RIDGE * rows / max(seconds, 1.0) * np.eye(len(shared)) / 10.0
    before, after = np.zeros(9), np.zeros(9)
    for held in range(count):
        train = [k for k in range(len(x)) if replay.flight_of[k] != held]
        a = sum(x[k].T @ x[k] for k in train) + penalty
        b = sum(x[k].T @ y[k] for k in train)
        weights = np.linalg.solve(a, b)
        for k in (k for k in range(len(x)) if replay.flight_of[k] == held):
            guess = x[k] @ weights
            guess -= guess.mean(0)
            before += (y[k] ** 2).sum(0)
            after += ((y[k] - guess) ** 2).sum(0)
    for number, axes in enumerate(AXES):
        axes = list(axes)
        share[number] = 1.0 - (after[axes] / spread[axes] ** 2).sum() / max(
            (before[axes] / spread[axes] ** 2).sum(), 1e-12
        )
    everything = np.linalg.solve(
        sum(v.T @ v for v in x) + penalty, sum(u.T @ v for u, v in zip(x, y, strict=True))
    )
    drivers = {}
    for number, axes in enumerate(AXES):
        size = np.abs(everything[:, list(axes)] / spread[list(axes)]).max(1)
        drivers[CHANNELS[number]] = [shared[i] for i in np.argsort(-size)[:3]]
    return np.maximum(share, 0.0) * (replay.usable[[a[0] for a in AXES]] > 0), drivers


def _uneven(track: Track, calm: np.ndarray) -> np.ndarray:
    """log ratio (6,) of the strongest to the median block's power."""
    size = max(int(BLOCK / track.dt), 1)
    rows = calm[int(SKIP / track.dt) :]
    count = len(rows) // size
    power = (rows[: count * size].reshape(count, size, 9) ** 2).mean(1) + 1e-20
    return np.array(
        [np.log(power[:, list(a)].mean(1).max() / np.median(power[:, list(a)].mean(1))) for a in AXES]
    )


def _incoherent(fit: SetFit) -> float:
    """Chi-square per parameter of single flights' parameters against the common ones, log10(1 + x)."""
    own = len(fit.index)
    if own == 0 or len(fit.grams) < 2:
        return 0.0
    total = 0.0
    for gram in fit.grams:
        hessian = gram[1:, 1:] + 1e-3 * np.linalg.inv(fit.covariance)
        total += float(gram[1:, 0] @ np.linalg.solve(hessian, gram[1:, 0]))
    return float(np.log10(1.0 + total / (own * (len(fit.grams) - 1))))
