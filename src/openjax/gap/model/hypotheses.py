"""Sets of physics effects as hypotheses: Gauss-Newton fits through the simulator, and
how well each explains a case.

Every set is fitted with the same nuisances and weighed by its marginal likelihood
(Laplace's approximation), so that parameters cost what they are worth.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from openjax.background import side_by_side
from openjax.gap.model.library import (
    ABSENT,
    CARDS,
    PLACE,
    Library,
    absent_beside,
    forbidden,
    places,
    prior,
)
from openjax.gap.model.replay import GROUPS, SKIP, Replay, block_count
from openjax.gap.model.whitening import fit_noise
from openjax.gap.shapes import Parameters, Rows

ITERATIONS = 6
SMALL_STEP = 0.05  # nats: an improvement below this ends the search
# degrees of freedom of the prior on a block's variance, whose scale is that of all
# blocks
STEADY = 20.0
# nats that a typical effect would leave: below, the effect isn't fitted at all
UNEXPOSED = 0.5


@dataclass(frozen=True, eq=False)
class SetFit:
    """A fitted set of effects."""

    replay: Replay
    """With nuisances as they are at the optimum."""
    effects: tuple[str, ...]
    theta: np.ndarray
    """(P,) parameters of all physics."""
    index: np.ndarray
    """(p,) places in it of the set's own."""
    precision: np.ndarray
    """(p, p) of their prior."""
    columns: list
    """[(1 + p, T, 9)]: residual and derivatives of each track at the optimum."""
    grams: np.ndarray
    """(F, 1 + p, 1 + p) inner products of those, by flight."""
    objective: float

    @property
    def hessian(self) -> np.ndarray:
        """(p, p) of the objective."""
        return self.grams.sum(0)[1:, 1:] + self.precision

    @cached_property
    def covariance(self) -> np.ndarray:
        """(p, p) of the posterior."""
        return np.linalg.inv(self.hessian)

    @cached_property
    def cost(self) -> float:
        """Nats that the parameters cost: how much narrower their posterior is than
        their prior.
        """
        _, posterior = np.linalg.slogdet(self.hessian)
        _, prior_logdet = np.linalg.slogdet(self.precision)
        return 0.5 * float(posterior - prior_logdet)

    @property
    def score(self) -> float:
        """The log marginal likelihood."""
        return -self.objective - self.cost

    def parameters(self) -> dict[str, dict[str, tuple[float, float]]]:
        """{effect: {parameter: (value, standard deviation)}} of the set's own
        effects.
        """
        deviation = dict(zip(self.index.tolist(), np.sqrt(np.diag(self.covariance)), strict=True))

        def estimate(key):
            return float(self.theta[PLACE[key]]), float(deviation[PLACE[key]])

        return {e: {p.name: estimate((e, p.name)) for p in CARDS[e].fitted} for e in self.effects}


def fit_set(
    replay: Replay,
    effects,
    start: Parameters | None = None,
    iterations: int = ITERATIONS,
    rounds: int = 1,
) -> SetFit:
    """Gauss-Newton from `start` (P,), by default the effects' first starts. After each
    of so many `rounds` nuisances of the vehicle's numbers, which depend on what acts,
    are worked out anew.
    """
    effects = tuple(effects)
    if start is None:
        start = replay.absent.copy()
        for effect in effects:
            start[places((effect,))] = _starts(effect, replay)[0][places((effect,))]
    fit = _at(replay, effects, replay.alone(effects, start))
    for _ in range(rounds if effects else 0):
        previous = fit
        fit = _descend(fit, iterations)
        fit = _at(fit.replay.around(fit.theta), effects, fit.theta, fit.columns)
        if np.allclose(previous.theta, fit.theta, rtol=1e-3, atol=0.0):
            break
    return fit


def _at(replay: Replay, effects, theta: np.ndarray, columns=None) -> SetFit:
    """The set with these parameters (P,), linearised there."""
    index, mean, precision = replay.prior(effects)
    columns = replay.linearise(theta, index) if columns is None else columns
    grams = replay.grams(columns)
    off = theta[index] - mean
    objective = 0.5 * float(grams[:, 0, 0].sum() + off @ precision @ off)
    return SetFit(replay, effects, theta, index, precision, columns, grams, objective)


def _descend(fit: SetFit, iterations: int) -> SetFit:
    """Steps of Gauss and Newton, half of one that overshoots, while they gain
    anything.
    """
    index, mean, precision = fit.replay.prior(fit.effects)
    # no step longer than three prior deviations: farther away the derivatives say
    # little
    reach = 3.0 * np.sqrt(np.diag(np.linalg.inv(precision)))
    most = np.array([p.most for e in fit.effects for p in CARDS[e].fitted])
    share = 1.0
    for _ in range(iterations):
        push = fit.grams.sum(0)[1:, 0] - precision @ (fit.theta[index] - mean)
        # what stands at its bound and would go beyond stays there
        free = np.flatnonzero((fit.theta[index] < most) | (push < 0.0))
        step = np.zeros(len(index))
        step[free] = np.linalg.solve(fit.hessian[np.ix_(free, free)], push[free])
        if 0.5 * push @ step < SMALL_STEP:
            break
        theta = fit.theta.copy()
        theta[index] += share * np.clip(step, -reach, reach)
        theta[index] = np.minimum(theta[index], most)
        # where a parameter means nothing any more there is no number, which is no gain
        with np.errstate(invalid="ignore"):
            ahead = _at(fit.replay, fit.effects, theta)
        gain = fit.objective - ahead.objective
        if gain > 0.0:
            fit = ahead
            share = 1.0
        else:
            share = 0.5 * share
        if 0.0 < gain < SMALL_STEP:
            break
    return fit


def model_noise(replay: Replay, library: Library) -> tuple[Replay, dict[str, float]]:
    """The replay with noise models that fit what is left when all effects of the
    library may act at once, and what each effect would show if it acted as at its start
    (nats, nuisances marginalised): its exposure.
    """
    starts = [(effect, theta) for effect in library.physics for theta in _starts(effect, replay)]
    index, _, precision = prior(library.physics, size_factors=replay.size_factors)
    columns = replay.linearise(replay.absent, index)
    ahead = np.array([theta for _, theta in starts])
    predictions = (
        replay.predict(ahead) if starts else [np.zeros((0, *n.shape)) for n in replay.nominal]
    )
    each = zip(columns, predictions, replay.nominal, strict=True)
    columns = [np.concatenate([c, m - n[None]]) for c, m, n in each]
    size = len(index)
    penalty = np.eye(size + len(starts))
    penalty[:size, :size] = precision
    # what effects take depends on the noise, and the noise on that: first without any
    # effect, until the noise models are near, and then with all
    for with_effects in (False, False, True, True):
        amplitudes = np.zeros(len(penalty))
        if with_effects:
            gram = replay.grams(columns).sum(0)
            amplitudes = np.linalg.solve(gram[1:, 1:] + penalty, gram[1:, 0])
        residuals_of_tracks = [c[0] - np.tensordot(amplitudes, c[1:], 1) for c in columns]
        residuals = [without_nuisances(replay, r, k) for k, r in enumerate(residuals_of_tracks)]
        replay = with_noise_of(replay, residuals)
    squares = np.diag(replay.grams(columns).sum(0))[1 + size :]
    exposure = {e: 0.0 for e in library.physics}
    for (effect, _), square in zip(starts, squares, strict=True):
        exposure[effect] = max(exposure[effect], 0.5 * float(square))
    return replay, exposure


def with_noise_of(replay: Replay, residuals: list[Float[np.ndarray, "_ channels"]]) -> Replay:
    """The replay with noise models of residuals; channels that weren't logged keep the
    present ones.
    """
    skip = int(SKIP / replay.tracks[0].dt)
    noises = tuple(
        fit_noise(axes, residuals, integrates, skip=skip) if replay.usable[axes[0]] else old
        for (axes, integrates), old in zip(GROUPS, replay.noises, strict=True)
    )
    replay = replace(replay, noises=noises, loudness=None)
    return replace(replay, loudness=tuple(_loudness(replay, r, k) for k, r in enumerate(residuals)))


def _loudness(replay: Replay, residual: np.ndarray, track: int) -> np.ndarray:
    """(T', 9) how loud the noise is in each block: rotors, air and what motors do
    between rows are quieter in hover than in a turn. The variance of a group of axes
    has a scaled inverse chi-squared prior (Gelman et al. 2013).
    """
    squares = replay.whiten(residual, track) ** 2
    out = np.ones_like(squares)
    blocks = block_count(len(squares), replay.tracks[track].dt)
    for rows in np.array_split(np.arange(len(squares)), blocks):
        for axes, _ in GROUPS:
            block = np.ix_(rows, axes)
            out[block] = (squares[block].sum() + STEADY) / (squares[block].size + STEADY)
    return np.sqrt(out)


def without_nuisances(replay: Replay, residual: Rows, track: int) -> Rows:
    """A residual (T, 9) less the nuisances' most likely part."""
    return residual - np.tensordot(
        replay.nuisance_sizes(residual, track), replay.nuisances[track], 1
    )


def fit_singles(replay: Replay, effects: Sequence[str]) -> dict[str, SetFit]:
    """The fit of each of the effects, alone but for what other estimators told."""
    fits = side_by_side(lambda effect: fit_single(replay, effect), effects)
    return dict(zip(effects, fits, strict=True))


def fit_single(replay: Replay, effect: str) -> SetFit:
    """The fit of one effect, alone but for what other estimators told. One that alone takes
    what physics forbids, as a floor that pulls where rotors differ, stays at its start:
    beside the others it is searched from there.
    """
    effects = in_order((effect, *replay.other_sizes))
    start = _at(replay, effects, replay.alone(effects, _best_start(replay, effect)))
    fit = _descend(start, ITERATIONS)
    return start if forbidden(fit.theta, (effect,), replay.physics.vehicles[0]) else fit


def in_order(effects: Collection[str]) -> tuple[str, ...]:
    """The effects as the library has them."""
    return tuple(e for e in CARDS if e in effects)


def _starts(effect: str, replay: Replay) -> np.ndarray:
    """The starts (S, P) of an effect's search, as far from what the vehicle has while
    nothing acts as its card says, for a vehicle of this size; what other estimators
    told is where they have it.
    """
    absent = absent_beside((effect,), replay.absent)
    starts = np.repeat(absent[None], 1 + len(CARDS[effect].others), 0)
    at = places((effect,))
    starts[:, at] = [[p.start for p in CARDS[effect].fitted], *CARDS[effect].others]
    starts[:, at] = starts[:, at] * replay.size_factors[at] + (absent - ABSENT)[at]
    for other, (mean, _) in replay.other_sizes.items():
        starts[:, places((other,))] = mean
    return starts


def _best_start(replay: Replay, effect: str) -> np.ndarray:
    """Of an effect's starts the one that explains most by itself."""
    starts = _starts(effect, replay)
    if len(starts) == 1:
        return starts[0]
    residuals = [
        y[None] - p for y, p in zip(replay.measurements, replay.predict(starts), strict=True)
    ]
    return starts[int(np.argmin(np.diag(replay.grams(residuals).sum(0))))]
