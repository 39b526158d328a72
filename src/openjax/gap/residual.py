"""What the chosen effects leave: whether it is more than sensors, air and errors of form leave.

Things that should agree are held against each other: measured motion and replay, attitude and gyroscope, path and
accelerometer, position and velocity. How much is left of each, how far what is left of two channels goes together, and what
Gaussian processes in random Fourier features (Rahimi, Recht 2007) of the state make the gap grow by, are told in standard
deviations of cases of several worlds in which nothing unknown acts. The p-value of the largest is conformal over those (Vovk
et al. 2005; `residual.json`)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

from openjax.flights.track import Track, rotation, smooth
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.hypotheses import SetFit, without_nuisances
from openjax.gap.model.replay import FORCE, RATES, SKIP, VELOCITY, Replay
from openjax.gap.model.table import HORIZONS as GAP

# s over which each residual is let add up, and what is said where it is large.
HORIZONS = {
    "velocity": (0.5, "forces are left over"),
    "rates": (0.5, "torques are left over"),
    "accelerometer": (0.5, "path and accelerometer disagree"),
    "estimator": (0.1, "attitude and gyroscope disagree"),
    "position": (0.1, "position and velocity disagree"),
}
WORDS = {name: words for name, (_, words) in HORIZONS.items()}
WORDS["correlation"] = "what is left of one channel goes with what is left of another"
WORDS["dependence"] = "what is left follows the state"
LEAST_GROWTH = 0.01  # of the gap, added: below, growths are alike
FEATURES = 40  # of each group
LENGTHS = (0.5, 1.0, 2.0)  # of the features, in standard deviations of what they are functions of
STATE_FILTER = 0.1  # s over which the state is smoothed: sensors' noise isn't what anything depends on
VARIANCES = 10.0 ** np.arange(-4.0, 4.5, 1.0)  # of the process, in units of the channel's noise
VERY_STRONG = 5.0  # nats of a Bayes factor (Kass, Raftery 1995)
WAKE = "the vehicle near"
CALIBRATION = Path(__file__).with_name("residual.json")


@dataclass(frozen=True)
class Check:
    """`measures` {name: value} and the one that stands out most, `where`; its `p_value` among cases without an unknown cause;
    `predicted` (6,): share of each motion channel's squared error beyond what such cases leave, where the check rejects."""

    measures: dict[str, float]
    where: str
    p_value: float
    predicted: np.ndarray

    @property
    def rejects(self) -> bool:
        """Whether what is left is more than noise."""
        return self.p_value <= DECISION.unknown

    @property
    def probability(self) -> float:
        """That something acts which no effect explains: posterior odds are the prior's over the p-value."""
        return DECISION.unknown / (DECISION.unknown + self.p_value)

    def in_words(self) -> str:
        """What is left, in one sentence."""
        return f"What is left isn't noise (p = {self.p_value:.2g}): {self.where}." if self.rejects else ""


def check_residual(evidence: Evidence, fit: SetFit) -> Check:
    """Whether a fit leaves no more than what cases without an unknown cause leave."""
    replay = evidence.replay
    residuals = residuals_of(replay, fit)
    measured, excess = measure(evidence, residuals)
    p_value, name = conformal_p(measured)
    predicted = excess if p_value <= DECISION.unknown else np.zeros(6)
    return Check(measured, WORDS[name], p_value, predicted)


def residuals_of(replay: Replay, fit: SetFit) -> list[np.ndarray]:
    """Residual (T, 9) of each track under a fit, nuisances taken off."""
    return [without_nuisances(replay, column[0], number) for number, column in enumerate(fit.columns)]


def disturbances(track: Track, residual: np.ndarray) -> np.ndarray:
    """A residual as accelerations (T, 9): angular (body), linear (body, from the velocity), specific force (body)."""
    out = np.zeros_like(residual)
    out[:, RATES] = np.gradient(residual[:, RATES], track.dt, axis=0)
    world = np.gradient(residual[:, VELOCITY], track.dt, axis=0)
    turn = np.eye(3)[None] if track.quaternion is None else rotation(track.quaternion)
    out[:, VELOCITY] = np.einsum("tji,tj->ti", np.broadcast_to(turn, (len(track), 3, 3)), world)
    out[:, FORCE] = residual[:, FORCE]
    return out


def measure(evidence: Evidence, residuals: list[np.ndarray]) -> tuple[dict[str, float], np.ndarray]:
    """{name: measure} of what is left, and (6,) by which share the motion channels' squares exceed what the calibration's cases
    leave at most."""
    replay, dt = evidence.replay, evidence.tracks[0].dt
    skip, out, excess = int(SKIP / dt), {}, np.zeros(6)
    for name, parts in _series(evidence, residuals).items():
        step = max(round(HORIZONS[name][0] / dt), 1)
        size = np.concatenate([(p[step:] - p[:-step])[skip:] for p in parts]).std(0)
        out[name] = float(size.max())
        if name in ("rates", "velocity"):
            most = np.quantile([c[name] for c in calibration() if name in c], 1.0 - DECISION.unknown)
            first = 0 if name == "rates" else 3
            excess[first : first + 3] = 1.0 - np.minimum(most / size, 1.0) ** 2
    white = np.concatenate([replay.whiten(r, k) for k, r in enumerate(residuals)])[:, replay.usable > 0]
    out["correlation"] = float(np.abs(np.triu(np.corrcoef(white.T), 1)).max())
    found, follows = dependence(replay, residuals), np.zeros(6)
    for gain, _, axis, share in found:
        if gain > VERY_STRONG:
            follows[axis] = max(follows[axis], share)
    out["dependence"] = float(np.sqrt((1.0 / (1.0 - follows[replay.heard > 0])).mean()) - 1.0) + LEAST_GROWTH
    return out, np.maximum(excess, follows)


def _series(evidence: Evidence, residuals: list[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """{name of HORIZONS: what is left (T, 3) of each track, added up} of what was logged."""
    usable, tracks = evidence.replay.usable, evidence.replay.tracks
    motion = {"rates": RATES, "velocity": VELOCITY}
    out = {n: [r[:, axes] for r in residuals] for n, axes in motion.items() if usable[axes.start]}
    out |= {c.path: c.fit.residual for c in evidence.channels if c.path in HORIZONS}
    if all(t.position is not None and t.velocity is not None for t in tracks):
        out["position"] = [t.position - _sum_of(t.velocity, t.dt) for t in tracks]
        if all(t.specific_force is not None and t.quaternion is not None for t in tracks):
            out["accelerometer"] = [_path_against_accelerometer(t) for t in tracks]
    return out


def _sum_of(rates: np.ndarray, dt: float) -> np.ndarray:
    """Integral (T, 3) of rates, linear between rows."""
    return np.cumsum(0.5 * (rates + np.concatenate([rates[:1], rates[:-1]])), 0) * dt


def _path_against_accelerometer(track: Track) -> np.ndarray:
    """Velocity (T, 3) body axes by which the accelerometer and the path's acceleration come apart, its bias aside."""
    path = np.gradient(track.velocity, track.dt, axis=0) + np.array([0.0, 0.0, 9.81])
    apart = track.specific_force - np.einsum("tji,tj->ti", rotation(track.quaternion), path)
    return np.cumsum(apart - apart.mean(0), 0) * track.dt


def conformal_p(measured: dict[str, float]) -> tuple[float, str]:
    """Share of cases without an unknown cause, this one among them, that stand out as much, and by which measure this one does.
    Beyond the largest the tail is exponential, as long as that of the upper quarter (Pickands 1975)."""
    value, name = standing_out(measured)
    known = np.array([standing_out(case)[0] for case in calibration()])
    share = float((1 + (known >= value).sum()) / (1 + len(known)))
    start = np.quantile(known, 0.75)
    scale = max(float((known[known >= start] - start).mean()), 1e-9)
    return share * float(np.exp(-max(value - known.max(), 0.0) / scale)), name


def standing_out(measured: dict[str, float]) -> tuple[float, str]:
    """How far a case's measures stand out of the calibration's at most, in its upper standard deviations of their logarithm,
    and by which one."""
    far = {n: (np.log(max(v, 1e-12)) - usual()[n][0]) / usual()[n][1] for n, v in measured.items()}
    name = max(far, key=far.get)
    return float(far[name]), name


@lru_cache(maxsize=1)
def calibration() -> list[dict[str, float]]:
    """The measures of cases without an unknown cause."""
    return json.loads(CALIBRATION.read_text(encoding="utf-8"))["cases"]


@lru_cache(maxsize=1)
def usual() -> dict[str, tuple[float, float]]:
    """{measure: the median of its logarithm and how far its upper standard deviation (norm's quantile) lies above}."""
    found = {}
    for name in WORDS:
        logs = np.log([max(c[name], 1e-12) for c in calibration() if name in c])
        middle, upper = np.quantile(logs, [0.5, norm.cdf(1.0)])
        found[name] = float(middle), float(upper - middle)
    return found


def state_groups(track: Track) -> dict[str, np.ndarray]:
    """{group: (T, n)} of the state that a push may depend on."""
    rows = len(track.time)
    turn = rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (rows, 1, 1))
    groups = {"the body rates": track.body_rates, "the thrust": track.motor.mean(1)[:, None]}
    if track.quaternion is not None:
        groups |= {"the attitude": turn[:, 2, :2], "the heading": turn[:, :2, 0]}
    if track.position is not None:
        groups["the place"] = track.position
    if track.velocity is not None:
        groups["the velocity"] = track.velocity
        groups["the velocity in the body's frame"] = np.einsum("tji,tj->ti", turn, track.velocity)
    if track.voltage is not None:
        groups["the voltage"] = track.voltage[:, None]
    groups |= {f"{WAKE} {k}": other - track.position for k, other in enumerate(track.neighbours)}
    groups = {name: smooth(values, STATE_FILTER, track.dt) for name, values in groups.items()}
    return groups | {"the time": (track.time - track.time[0])[:, None]}


def dependence(replay: Replay, residuals: list[np.ndarray]) -> list[tuple[float, str, int, float]]:
    """Of each motion channel and group of the state: log Bayes factor, words, axis (0 to 5) and the share that the process has
    of the squared errors that make the gap."""
    states, found = [state_groups(t) for t in replay.tracks], [(0.0, "", 0, 0.0)]
    for group in (g for g in states[0] if all(g in s for s in states)):
        features = _fourier_features([s[group] for s in states])
        if features is None:
            continue
        for axis in np.flatnonzero(replay.heard > 0):
            if group.startswith(WAKE) and axis < 3:
                continue  # how wakes turn a vehicle is a nuisance
            channel = int(axis) if axis < 3 or replay.usable[3] else int(axis) + 3
            gain, weights = _log_bayes_factor(*_whitened_sums(replay, residuals, features, channel))
            pushes = [
                _done(f, channel, t.dt) @ weights[:, None]
                for f, t in zip(features, replay.tracks, strict=True)
            ]
            share = _share_of_errors(replay, residuals, pushes, channel) if gain > 0.0 else 0.0
            found.append((gain, f"{_name(channel)} depends on {group}", int(axis), share))
    return found


def _fourier_features(states: list[np.ndarray]) -> list[np.ndarray] | None:
    """Random Fourier features (T, FEATURES) of each track's state (T, n) in its standard deviations over all tracks."""
    every = np.concatenate(states)
    spread = every.std(0)
    moving = spread > 1e-6 * (1.0 + np.abs(every).max(0))
    if not moving.any():
        return None
    generator = np.random.default_rng(0)
    weights = generator.standard_normal((int(moving.sum()), FEATURES)) / generator.choice(LENGTHS, FEATURES)
    phases = generator.uniform(0.0, 2.0 * np.pi, FEATURES)
    scaled = [(s - every.mean(0))[:, moving] / spread[moving] for s in states]
    features = [np.cos(s @ weights + phases) * np.sqrt(2.0 / FEATURES) for s in scaled]
    return [f - f.mean(0) for f in features]  # a trim is nobody's surprise


def _done(push: np.ndarray, channel: int, dt: float) -> np.ndarray:
    """What accelerations (T, n) do to a channel: rates and velocity add them up."""
    return push if channel >= 6 else np.cumsum(push, 0) * dt


def _share_of_errors(replay: Replay, residuals, shapes, channel: int) -> float:
    """Share of a channel's squared errors over the gap's horizon that `shapes` [(T, n)], least squares, explain."""
    gram, cross, square = 1e-12, 0.0, 1e-12
    for track, residual, shape in zip(replay.tracks, residuals, shapes, strict=True):
        both = np.concatenate([shape, residual[:, [channel]]], 1)
        both = both if channel < 6 else np.cumsum(both, 0) * track.dt
        step = max(round(GAP["rates" if channel < 3 else "velocity"] / track.dt), 1)
        moved = (both[step:] - both[:-step])[int(SKIP / track.dt) :]
        gram, cross = gram + moved[:, :-1].T @ moved[:, :-1], cross + moved[:, :-1].T @ moved[:, -1]
        square += float(moved[:, -1] @ moved[:, -1])
    return float(np.clip(cross @ np.linalg.lstsq(gram, cross, rcond=None)[0] / square, 0.0, 0.99))


def _whitened_sums(replay: Replay, residuals, features, channel: int) -> tuple[np.ndarray, np.ndarray]:
    """Inner products of what the features would do in a channel, whitened, with each other and with the residual."""
    noise = next(n for n in replay.noises if channel in n.axes)
    gram, cross = 0.0, 0.0
    for track, residual, push in zip(replay.tracks, residuals, features, strict=True):
        both = np.concatenate([_done(push, channel, track.dt), residual[:, [channel]]], 1)
        white = lfilter(noise.numerator / noise.deviation, noise.denominator, both, axis=0)
        white = white[int(SKIP / track.dt) :]
        white = white - white.mean(0)
        gram, cross = gram + white[:, :-1].T @ white[:, :-1], cross + white[:, :-1].T @ white[:, -1]
    return gram, cross


def _log_bayes_factor(gram: np.ndarray, cross: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a linear model with independent normal coefficients against none, at the variance that fits best, and the
    coefficients."""
    values, vectors = np.linalg.eigh(gram)
    values, along = np.maximum(values, 0.0), vectors.T @ cross
    each = [0.5 * (v * along**2 / (1.0 + v * values) - np.log1p(v * values)).sum() for v in VARIANCES]
    best = int(np.argmax(each))
    taken = VARIANCES[best] * along / (1.0 + VARIANCES[best] * values)
    return max(0.0, float(each[best])), vectors @ taken


def _name(channel: int) -> str:
    return f"{('torque', 'force', 'specific force')[channel // 3]} {'xyz'[channel % 3]}"
