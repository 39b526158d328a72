"""What is local in time: pushes that come, go and switch, and torques that change once and stay.

No regressor knows when; so what is left is compared with itself. Turbulence and the sensors' noise, of whatever
colour, are linear and normal; a surrogate of a signal - its spectrum, with phases drawn anew (Theiler et al. 1992,
Physica D 58, 77-94) - is what such a process of the same flights would give. What levels and jumps explain of the signal,
they would then explain of its surrogates as well.

Pushes are looked for in the sideways specific force: no motor makes it, and turbulence changes it slowly. Vertical force and
quick torques don't serve: what late clocks, single samples of motors and interpolated poses have wrong is largest where the
motors work most. A torque that changes once, for good, is another matter: a fault, a loose battery."""

from __future__ import annotations

import numpy as np

from openjax.flights.track import Track
from openjax.gap.replay import FORCE, RATES, SKIP, VELOCITY

SURROGATES = 40
CLEAR = 5.0  # standard deviations of the surrogates' statistic
PIECE = 10.0  # s: longer tracks are cut
SHORTEST = 3.0  # s

WIDTHS = (0.05, 0.1)  # s of the means whose jumps are looked at; levels are looked for in the last
CHANGES = (6, 9, 12)  # between levels, in a piece
ALONG = 0.3  # s of the means that tell the direction of the pushes
PUSH = 0.1  # m/s^2, a hundredth of the weight: the largest must be more to matter

STEADY = 0.25  # s of the means that a change for good is looked for in
LASTING = 6  # of them at least before and after
EDGE = 0.1  # s left out at the end of a track
TURN = 1.0  # rad/s^2: the least change of torque that matters
MOST = 0.4  # of a track's torque that one change must explain


def knocks(tracks: list[Track], disturbed: list[np.ndarray], usable: np.ndarray) -> tuple[str, ...]:
    """Findings in words. disturbed [(T, 9)]: what is left as accelerations, see `rest.disturbances`; usable (9,)."""
    generator = np.random.default_rng(0)
    return (*_pushes(tracks, disturbed, usable, generator), *_changed(tracks, disturbed, usable, generator))


def _pushes(tracks, disturbed, usable, generator) -> tuple[str, ...]:
    """Levels and jumps in the sideways specific force, along the direction that it varies most in and across."""
    if usable[FORCE][:2].min() <= 0.0:
        return ()
    parts = [(d[int(SKIP / t.dt) :], t.dt) for t, d in zip(tracks, disturbed, strict=True)]
    turn = _directions(parts, bool(usable[VELOCITY].min() > 0.0))
    levels, jumps, largest = 0.0, 0.0, 0.0
    for part, dt in parts:
        for piece in _pieces(part[:, FORCE][:, :2] @ turn, dt):
            drawn, moments = _with_surrogates(piece, generator), []
            for width in WIDTHS:
                means = _means(drawn, max(round(width / dt), 1))
                steps = np.diff(means, axis=1)[..., 0]
                moments.append(
                    [(steps**4).sum(1), (steps**2).sum(1), np.full(len(steps), float(steps.shape[1]))]
                )
                largest = max(largest, float(np.abs(steps[0]).max()))
            left = _levels(means, max(CHANGES))[..., np.array(CHANGES) - 1]
            levels, jumps = levels - means.shape[1] * np.log(left).sum(2), jumps + np.array(moments)
    if largest < PUSH:
        return ()
    fourth, second, number = np.moveaxis(jumps, 1, 0)
    kurtosis = np.log(fourth / second**2 * number)
    if max(map(_above, (levels[:, 0], levels.sum(1), *kurtosis))) < CLEAR:
        return ()
    return (f"pushes to the side that come and go, by up to {largest:.1f} m/s^2 within {WIDTHS[-1]:g} s",)


def _changed(tracks, disturbed, usable, generator) -> tuple[str, ...]:
    """A torque that changes once in a flight and stays."""
    if usable[RATES].min() <= 0.0 or not all(t.motors_logged for t in tracks):
        return ()
    scores, best = [], (0.0, "")
    for track, d in zip(tracks, disturbed, strict=True):
        size = max(round(STEADY / track.dt), 1)
        part = d[int(2 * STEADY / track.dt) : len(d) - max(int(EDGE / track.dt), 1), RATES]
        if len(part) < 2 * LASTING * size:
            continue
        means = _means(_with_surrogates(part, generator), size)
        score, place, explained, jump = _split(means)
        scores.append(score)
        large = np.abs(jump[0]) * (explained[0] > MOST)
        if large.max() > TURN:
            when = (place[0] + 2) * STEADY
            words = f"a torque about {'xyz'[int(large.argmax())]} that changes by {large.max():.1f} rad/s^2"
            best = max(best, (_above(-score), f"{words} after {when:.1f} s and stays ({track.name})"))
    if not best[1] or max(best[0], _above(-np.sum(scores, 0))) < CLEAR:
        return ()
    return (best[1],)


def _directions(parts, posed: bool) -> np.ndarray:
    """(2, 2) sideways directions as columns, the one of the largest pushes first; noise of two sensors isn't shared."""
    shared = np.zeros((2, 2))
    for part, dt in parts:
        size = max(round(ALONG / dt), 1)
        if len(part) < 2 * size:
            continue
        felt, moved = (
            _means(part[None, :, axes][..., :2], size)[0] for axes in (FORCE, VELOCITY if posed else FORCE)
        )
        shared += (felt - felt.mean(0)).T @ (moved - moved.mean(0))
    return np.linalg.eigh(shared + shared.T)[1][:, ::-1]


def _pieces(values: np.ndarray, dt: float) -> list[np.ndarray]:
    """Pieces (T', C) of values (T, C) that are neither too long nor too short."""
    return [
        p
        for p in np.array_split(values, int(np.ceil(len(values) * dt / PIECE)) or 1)
        if len(p) * dt > SHORTEST
    ]


def _with_surrogates(values: np.ndarray, generator) -> np.ndarray:
    """(1 + S, T, C): the values (T, C) about their mean and surrogates of them."""
    values = values - values.mean(0)
    spectrum = np.fft.rfft(values, axis=0)
    turned = spectrum * np.exp(2j * np.pi * generator.random((SURROGATES, *spectrum.shape)))
    return np.concatenate([values[None], np.fft.irfft(turned, len(values), axis=1)])


def _means(values: np.ndarray, size: int) -> np.ndarray:
    """Means (S, N, C) of values (S, T, C) over `size` rows."""
    count = values.shape[1] // size
    return values[:, : count * size].reshape(len(values), count, size, -1).mean(2)


def _levels(values: np.ndarray, changes: int) -> np.ndarray:
    """What is left, of the squares of (S, N, C), of the best steps with 1, 2, ... `changes` changes: (S, C, changes)."""
    s, n, c = values.shape
    x = np.moveaxis(values, 2, 1).reshape(s * c, n)
    x = x - x.mean(1, keepdims=True)
    zero = np.zeros((s * c, 1))
    total, square = (np.concatenate([zero, np.cumsum(v, 1)], 1) for v in (x, x**2))
    at = np.arange(n + 1)
    length = np.maximum(at[None] - at[:, None], 1)
    cost = square[:, None] - square[..., None] - (total[:, None] - total[..., None]) ** 2 / length
    cost = np.where(at[None] > at[:, None], cost, np.inf)
    best, out = cost[:, 0], []
    for _ in range(changes):
        best = np.minimum(best, (best[..., None] + cost).min(1))
        out.append(best[:, n])
    return (np.maximum(np.stack(out, 1), 1e-30) / cost[:, 0, n:]).reshape(s, c, changes)


def _split(values: np.ndarray):
    """The best change once, at the same time on all axes, of (S, N, C): its score (S,), smaller is better, place (S,), share
    explained (S, C) and jump (S, C)."""
    n = values.shape[1]
    total, square = np.cumsum(values, 1), (values**2).sum(1)
    whole = square - total[:, -1] ** 2 / n
    at = np.arange(LASTING, n - LASTING + 1)
    before, after = total[:, at - 1] / at[:, None], (total[:, -1:] - total[:, at - 1]) / (n - at)[:, None]
    share = (at * (n - at) / n)[:, None] * (after - before) ** 2 / whole[:, None]
    score = n * np.log(np.maximum(1.0 - share, 1e-12)).sum(2)
    rows, best = np.arange(len(values)), score.argmin(1)
    return score[rows, best], at[best], share[rows, best], (after - before)[rows, best]


def _above(statistic: np.ndarray) -> float:
    """By how many of their standard deviations the first of a statistic (1 + S,) is above the surrogates'."""
    return float((statistic[0] - statistic[1:].mean()) / (statistic[1:].std() + 1e-12))
