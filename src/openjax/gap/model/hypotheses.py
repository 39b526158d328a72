"""Sets of physics effects as hypotheses: Gauss-Newton fits through the simulator, and how well each explains
a case.

Every set is fitted with the same nuisances and weighed by its marginal likelihood (Laplace's
approximation), so that parameters cost what they are worth. Singles and the best sets are fitted in full;
the other pairs are weighed by adding the linearised singles."""

from dataclasses import dataclass

import numpy as np

from openjax.gap.model.library import ABSENT, CARDS, PLACE, Library, places, prior, start_of
from openjax.gap.model.replay import GROUPS, SKIP, Replay
from openjax.gap.model.whitening import Noise, fit_noise

ITERATIONS = 6
SMALL_STEP = 0.05  # nats: an improvement below this ends the search
UNEXPOSED = 0.5  # nats that a typical effect would leave: below, the effect isn't fitted at all


@dataclass(frozen=True, eq=False)
class SetFit:
    """A fitted set of effects. `replay`: with nuisances as they are there; `grams` (F, 1 + p, 1 + p) of residual and derivatives
    at the optimum, by flight; `score` the log marginal likelihood; `index` (p,) places in `theta` (P,)."""

    replay: Replay
    effects: tuple[str, ...]
    theta: np.ndarray
    index: np.ndarray
    grams: np.ndarray
    columns: list
    covariance: np.ndarray
    score: float

    def parameters(self) -> dict[str, dict[str, tuple[float, float]]]:
        """{effect: {parameter: (value, standard deviation)}} of the set's own effects."""
        deviation = dict(zip(self.index.tolist(), np.sqrt(np.diag(self.covariance)), strict=True))
        own = {e: {p.name: PLACE[e, p.name] for p in CARDS[e].fitted} for e in self.effects}
        return {
            e: {p: (float(self.theta[k]), float(deviation[k])) for p, k in found.items()}
            for e, found in own.items()
        }


def fit_set(
    replay: Replay, effects, start: np.ndarray | None = None, iterations: int = ITERATIONS, rounds: int = 1
) -> SetFit:
    """Gauss-Newton from `start` (P,), by default the effects' first starts. After each of so many `rounds` nuisances of the
    vehicle's numbers, which depend on what acts, are worked out anew."""
    effects = tuple(effects)
    index, mean, precision = prior(effects)
    theta = ABSENT.copy()  # what isn't in the set is absent
    for effect in effects:
        own = places((effect,))
        theta[own] = start_of(effect) if start is None else start[own]
    point = _point(replay, theta, index, mean, precision)
    for _ in range(rounds if effects else 0):
        before, point = point, _around(_descend(point, mean, precision, iterations), mean, precision)
        if np.allclose(before.theta, point.theta, rtol=1e-3, atol=0.0):
            break
    hessian = point.grams.sum(0)[1:, 1:] + precision
    covariance = np.linalg.inv(hessian) if effects else np.zeros((0, 0))
    volume = np.linalg.slogdet(hessian)[1] - np.linalg.slogdet(precision)[1] if effects else 0.0
    score = float(-point.objective - 0.5 * volume)
    return SetFit(point.replay, effects, point.theta, index, point.grams, point.columns, covariance, score)


@dataclass(frozen=True, eq=False)
class _Point:
    """A set's parameters with what the data say around them."""

    replay: Replay
    theta: np.ndarray
    index: np.ndarray
    columns: list
    grams: np.ndarray
    objective: float


def _point(replay: Replay, theta, index, mean, precision, columns=None) -> _Point:
    columns = replay.linearised(theta, index) if columns is None else columns
    grams, off = replay.grams(columns), theta[index] - mean
    objective = 0.5 * float(grams[:, 0, 0].sum() + off @ precision @ off)
    return _Point(replay, theta, index, columns, grams, objective)


def _around(point: _Point, mean, precision) -> _Point:
    """The same with nuisances as they are there."""
    replay = point.replay.around(point.theta)
    return _point(replay, point.theta, point.index, mean, precision, point.columns)


def _descend(point: _Point, mean, precision, iterations: int) -> _Point:
    """Steps of Gauss and Newton, half of one that overshoots, while they gain anything."""
    reach = 3.0 * np.sqrt(np.diag(np.linalg.inv(precision)))
    share = 1.0
    for _ in range(iterations):
        gram, off = point.grams.sum(0), point.theta[point.index] - mean
        push = gram[1:, 0] - precision @ off
        step = np.linalg.solve(gram[1:, 1:] + precision, push)
        if 0.5 * push @ step < SMALL_STEP:
            break
        theta = point.theta.copy()
        theta[point.index] += share * np.clip(step, -reach, reach)
        ahead = _point(point.replay, theta, point.index, mean, precision)
        gain = point.objective - ahead.objective
        point, share = (ahead, 1.0) if gain > 0.0 else (point, 0.5 * share)
        if 0.0 < gain < SMALL_STEP:
            break
    return point


def model_noise(replay: Replay, library: Library) -> tuple[Replay, dict[str, float]]:
    """The replay with noise models that fit what is left when all effects of the library may act at once, and what each effect
    would show if it acted as at its start (nats, nuisances marginalised): its exposure."""
    theta = ABSENT.copy()
    ahead, firsts = [], []
    for effect in library.physics:
        for number in range(1 + len(CARDS[effect].others)):
            firsts.append(effect)
            point = ABSENT.copy()
            point[places((effect,))] = start_of(effect, number)
            ahead.append(point)
    index, _, precision = prior(library.physics)
    columns = replay.linearised(theta, index)
    moved = replay.predict(np.array(ahead)) if ahead else [np.zeros((0, *n.shape)) for n in replay.nominal]
    columns = [
        np.concatenate([c, m - n[None]]) for c, m, n in zip(columns, moved, replay.nominal, strict=True)
    ]
    size = len(index)
    penalty = np.eye(size + len(ahead))
    penalty[:size, :size] = precision
    for weighed in (False, False, True, True):
        gram = replay.grams(columns).sum(0)
        taken = np.linalg.solve(gram[1:, 1:] + penalty, gram[1:, 0]) if weighed else np.zeros(len(penalty))
        left = [c[0] - np.tensordot(taken, c[1:], 1) for c in columns]
        replay = replay.with_noise(
            noise_of(replay, [without_nuisances(replay, r, k) for k, r in enumerate(left)])
        )
    shown = np.diag(replay.grams(columns).sum(0))[1 + size :]
    exposure = {e: 0.0 for e in library.physics}
    for effect, square in zip(firsts, shown, strict=True):
        exposure[effect] = max(exposure[effect], 0.5 * float(square))
    return replay, exposure


def noise_of(replay: Replay, residuals: list[np.ndarray]) -> list[Noise]:
    """Noise models of residuals; channels that weren't logged keep the present ones."""
    skip = int(SKIP / replay.tracks[0].dt)
    return [
        fit_noise(axes, residuals, integrated, skip=skip) if replay.usable[axes[0]] else old
        for (axes, integrated), old in zip(GROUPS, replay.noises, strict=True)
    ]


def without_nuisances(replay: Replay, residual: np.ndarray, track: int) -> np.ndarray:
    """A residual (T, 9) less the nuisances' most likely part."""
    return residual - np.tensordot(replay.taken(residual, track), replay.nuisances[track], 1)


def fit_singles(replay: Replay, library: Library, exposure) -> dict[str, SetFit]:
    """The fit of every effect alone that the flights could show."""
    shown = [effect for effect in library.physics if exposure[effect] >= UNEXPOSED]
    return {effect: fit_set(replay, (effect,), _best_start(replay, effect)) for effect in shown}


def _best_start(replay: Replay, effect: str) -> np.ndarray:
    """Of an effect's starts the one that explains most by itself."""
    starts = np.repeat(ABSENT[None], 1 + len(CARDS[effect].others), 0)
    for number, start in enumerate(starts):
        start[places((effect,))] = start_of(effect, number)
    if len(starts) == 1:
        return starts[0]
    left = [y[None] - p for y, p in zip(replay.measured, replay.predict(starts), strict=True)]
    return starts[int(np.argmin(np.diag(replay.grams(left).sum(0))))]
