"""Sets of physics effects as hypotheses: Gauss-Newton fits through the simulator, and how well each explains
a case.

Every set is fitted with the same nuisances and weighed by its marginal likelihood (Laplace's
approximation), so that parameters cost what they are worth. Singles and the best sets are fitted in full;
the other pairs are weighed by adding the linearised singles."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from openjax.gap.model.bounds import held_objective
from openjax.gap.model.library import ABSENT, CARDS, PLACE, STEP, Library, places, prior, start_of
from openjax.gap.model.replay import GROUPS, SKIP, Replay, stepped
from openjax.gap.model.whitening import Noise, fit_noise

ITERATIONS = 6
SMALL_STEP = 0.05  # nats: an improvement below this ends the search
WORTH_ALL = 60.0  # nats: all effects together must explain this much of a channel to count in its noise model
SIZES = (0.05, 4.0)  # of a start that is scaled
UNEXPOSED = 0.5  # nats that a typical effect would leave: below, the effect isn't fitted at all


@dataclass(frozen=True, eq=False)
class SetFit:
    """A fitted set of effects. `grams` (F, 1 + p, 1 + p) of residual and derivatives at the optimum, by
    flight; `score` the log marginal likelihood; `index` (p,) places in `theta` (P,)."""

    effects: tuple[str, ...]
    theta: np.ndarray
    index: np.ndarray
    grams: np.ndarray
    columns: list
    covariance: np.ndarray
    score: float

    def parameters(self) -> dict[str, dict[str, tuple[float, float]]]:
        """{effect: {parameter: (value, standard deviation)}} of the set's own effects."""
        return _named(self.effects, self.theta, self.index, self.covariance)


def fit_set(replay: Replay, effects, start: np.ndarray | None = None, iterations: int = ITERATIONS) -> SetFit:
    """Gauss-Newton from `start` (P,), by default the effects' first starts."""
    effects = tuple(effects)
    index, mean, precision = prior(effects)
    if start is None:
        start = ABSENT.copy()
        for effect in effects:
            start[places((effect,))] = start_of(effect)
    theta, best = ABSENT.copy(), None
    theta[index] = start[index]  # what isn't in the set is absent
    reach = 3.0 * np.sqrt(np.diag(np.linalg.inv(precision))) if len(index) else np.zeros(0)
    for iteration in range(iterations + 1):
        columns = replay.linearised(theta, index)
        products = replay.products(columns)
        grams = replay.marginal(products)
        gram, off = grams.sum(0), theta[index] - mean
        objective = 0.5 * gram[0, 0] + 0.5 * off @ precision @ off
        if best is not None and not objective < best[0] - SMALL_STEP:
            if objective < best[0]:
                best = (objective, theta.copy(), grams, columns, products)
                break
            if not np.isfinite(objective) or objective > best[0] + 1.0:
                if iteration < iterations:  # overshot: half way back
                    theta = 0.5 * (theta + best[1])
                    continue
            break
        best = (objective, theta.copy(), grams, columns, products)
        if not len(index):
            break
        push, step, _ = _newton(gram, precision, off)
        if 0.5 * push @ step < SMALL_STEP:
            break
        theta = theta.copy()
        theta[index] += np.clip(step, -reach, reach)
    _, theta, grams, columns, products = best
    hessian = grams.sum(0)[1:, 1:] + precision
    covariance = np.linalg.inv(hessian) if len(index) else np.zeros((0, 0))
    volume = np.linalg.slogdet(hessian)[1] - np.linalg.slogdet(precision)[1] if len(index) else 0.0
    score = -_held(replay, products, theta[index] - mean, precision) - 0.5 * volume
    score += _sign_term(effects, index, theta, covariance)
    return SetFit(effects, theta, index, grams, columns, covariance, float(score))


def _newton(gram, precision, off) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right side, step and Hessian of Gauss and Newton, from inner products of residual and derivatives (1 + p, 1 + p) and how
    far parameters are `off` their prior's mean."""
    push, hessian = gram[1:, 0] - precision @ off, gram[1:, 1:] + precision
    return push, np.linalg.solve(hessian, push), hessian


def linearised_at(replay: Replay, fit: SetFit, index) -> list[np.ndarray]:
    """`Replay.linearised` at a fit; what the fit was made of isn't worked out again."""
    own = {int(i): 1 + k for k, i in enumerate(fit.index)}
    new = [int(i) for i in index if int(i) not in own]
    moved = (
        replay.predict(stepped(fit.theta, new)[1:])
        if new
        else [np.zeros((0, *y.shape)) for y in replay.measured]
    )
    steps = STEP[new][:, None, None]
    out = []
    for column, y, m in zip(fit.columns, replay.measured, moved, strict=True):
        further = dict(zip(new, (m - (y - column[0])) / steps, strict=True))
        out.append(
            np.stack([column[0], *(column[own[int(i)]] if int(i) in own else further[int(i)] for i in index)])
        )
    return out


def _named(effects, theta, index, covariance) -> dict[str, dict[str, tuple[float, float]]]:
    deviation = dict(zip(index.tolist(), np.sqrt(np.diag(covariance)), strict=True))
    return {
        e: {
            p.name: (float(theta[PLACE[e, p.name]]), float(deviation[PLACE[e, p.name]]))
            for p in CARDS[e].fitted
        }
        for e in effects
    }


def _sign_term(effects, index, theta, covariance) -> float:
    """Log of how much likelier the right signs are after the fit than before."""
    total = 0.0
    for place, deviation in zip(index, np.sqrt(np.diag(covariance)), strict=True):
        for effect in effects:
            for parameter in CARDS[effect].fitted:
                if parameter.positive and PLACE[effect, parameter.name] == place:
                    total += norm.logcdf((theta[place] - ABSENT[place]) / deviation) + np.log(2.0)
    return float(total)


def _held(replay: Replay, products, off: np.ndarray, precision: np.ndarray) -> float:
    """Least objective of a set, `off` from its prior's mean, with nuisances within their bounds and the vehicle's alike in
    all flights."""
    grams = [
        np.block([[gram, cross], [cross.T, inner]])
        for (gram, cross), inner in zip(products, replay.nuisance_grams, strict=True)
    ]
    return held_objective(grams, replay.shared, off, precision)


def model_noise(replay: Replay, library: Library) -> tuple[Replay, list[np.ndarray], dict[str, float]]:
    """The replay with noise models that fit what is left when all effects of the library may act at once; the residuals
    [(T, 9)], and what each effect would show if it acted as at its start (nats, nuisances marginalised): its exposure."""
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
    replay, nothing = _settle(replay, columns, lambda _: np.zeros(len(penalty)))
    alone = replay.noises

    def weights(replay):
        gram = replay.grams(columns).sum(0)
        return np.linalg.solve(gram[1:, 1:] + penalty, gram[1:, 0])

    replay, residuals = _settle(replay, columns, weights)
    together = replay.noises
    # Where all effects together explain no more than so many parameters must, the noise is that of no effect:
    # in calm flights feedback makes disturbances look like weak motors, and a noise model made under that
    # would confirm it.
    chosen = []
    for group, (none, full) in enumerate(zip(alone, together, strict=True)):
        axes = list(GROUPS[group][0])
        gained = len(axes) * sum(len(t) for t in replay.tracks) * np.log(none.deviation / full.deviation)
        chosen.append(full if gained > WORTH_ALL else none)
        if gained <= WORTH_ALL:
            for left, calm in zip(residuals, nothing, strict=True):
                left[:, axes] = calm[:, axes]
    replay = replay.with_noise(chosen)
    shown = np.diag(replay.grams(columns).sum(0))[1 + size :]
    exposure = {e: 0.0 for e in library.physics}
    for effect, square in zip(firsts, shown, strict=True):
        exposure[effect] = max(exposure[effect], 0.5 * float(square))
    return replay, residuals, exposure


def _settle(replay: Replay, columns, weights) -> tuple[Replay, list[np.ndarray]]:
    """The replay with noise models that suit its residuals [(T, 9)] with `weights(replay)` of the columns, and these."""
    for _ in range(2):
        taken = weights(replay)
        residuals = [
            without_nuisances(replay, c[0] - np.tensordot(taken, c[1:], 1), number)
            for number, c in enumerate(columns)
        ]
        replay = replay.with_noise(noise_of(replay, residuals))
    return replay, residuals


def noise_of(replay: Replay, residuals: list[np.ndarray]) -> list[Noise]:
    """Noise models of residuals; channels that weren't logged keep the present ones."""
    skip = int(SKIP / replay.tracks[0].dt)
    return [
        fit_noise(axes, residuals, integrated, skip=skip) if replay.usable[axes[0]] else old
        for (axes, integrated), old in zip(GROUPS, replay.noises, strict=True)
    ]


def without_nuisances(
    replay: Replay, residual: np.ndarray, track: int, stay: np.ndarray | None = None
) -> np.ndarray:
    """A residual (T, 9) less the nuisances' most likely part, but that of those (N,) that `stay`."""
    taken = replay.taken(residual, track)
    if stay is not None:
        taken = np.where(stay, 0.0, taken)
    return residual - np.tensordot(taken, replay.nuisances[track], 1)


def fit_singles(replay: Replay, library: Library, exposure) -> tuple[SetFit, dict[str, SetFit]]:
    """Fits of no effect and of every effect alone that the flights could show."""
    found = {}
    for effect in library.physics:
        if exposure[effect] >= UNEXPOSED:
            found[effect] = fit_set(replay, (effect,), _best_start(replay, effect))
    return fit_set(replay, ()), found


def _best_start(replay: Replay, effect: str) -> np.ndarray:
    """Of an effect's starts the one that explains most by itself, at the size that explains most."""
    starts = []
    for number in range(1 + len(CARDS[effect].others)):
        start = ABSENT.copy()
        start[places((effect,))] = start_of(effect, number)
        starts.append(start)
    if len(starts) == 1:
        return starts[0]
    moved = replay.predict(np.array(starts))
    if not CARDS[effect].linear:
        residuals = [y[None] - p for y, p in zip(replay.measured, moved, strict=True)]
        return starts[int(np.argmin(np.diag(replay.grams(residuals).sum(0))))]
    columns = [
        np.concatenate([(y - n)[None], m - n[None]])
        for y, n, m in zip(replay.measured, replay.nominal, moved, strict=True)
    ]
    gram = replay.grams(columns).sum(0)
    size = np.clip(gram[0, 1:] / (np.diag(gram)[1:] + 1e-9), *SIZES)
    best = int(np.argmax(size * gram[0, 1:] - 0.5 * size**2 * np.diag(gram)[1:]))
    first = places((effect,))[0]
    starts[best][first] *= size[best]
    return starts[best]
