"""Motor lag, inertia and yaw torque, named from how the torques were identified.

The replay of the motion gives up what feedback does within a block, and with it most of
what a lag shows; the identification keeps it. So these causes are told by the
identification alone, wherever it is trusted, and the replay takes their sizes from it.

Lags add up as phases, gains as logarithms. A weaker thrust turns the vehicle as larger
moments of inertia do, so what thrust the other effects leave is taken off first.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from openjax.gap.decision import DECISION
from openjax.gap.identification.changes import GAIN_OF_LAG, change_of, comparable
from openjax.gap.identification.estimates import TORQUES, EffectEstimates, of_fit
from openjax.gap.identification.quantities import TALKED_OF, Identification
from openjax.gap.model.library import CARDS, PLACE
from openjax.gap.model.nuisances import SIZE
from openjax.gap.posterior import Cause, Estimate, Explanation, explain

LAG, INERTIA, YAW = TORQUES
NAMES = ("phase up", "phase down", "delay", "roll gain", "pitch gain", "yaw gain")
"""rad at TALKED_OF, s, and logarithms of one over the gain, of yaw of the gain."""
TURN = 2.0 * np.pi * TALKED_OF  # rad/s
BAND = 2.0 * np.pi * np.array([3.0, 5.0, 8.0])  # rad/s, where rate loops work
HOVER = 0.62  # of the largest thrust, where the slope of a thrust curve is taken
LEAST_GAIN = 0.03
ALIKE = np.array([0.0, 0.0, 0.0, 1.0, 1.0, -1.0])
"""What another slope of the thrust does to the gains."""
LATE = "late"
"""A delay that is no lag of first order: told as a lag, whose place it takes."""
DRAWS = np.random.default_rng(0).standard_normal((256, 3))


@dataclass(frozen=True, eq=False)
class Torques:
    """The `estimate` of NAMES beside the vehicle that has
    `nominal` (P,), whose motors' time constants are `lags` (2,), s.
    """

    estimate: Estimate
    nominal: np.ndarray
    lags: np.ndarray
    effects: tuple[str, ...] = TORQUES
    """Those that these logs can show at all."""

    @cached_property
    def explanations(self) -> list[Explanation]:
        """Sets of causes, the likeliest first."""
        causes = [c for c in CAUSES if c.name in (*self.effects, LATE)]
        return explain(self.estimate, causes)

    @cached_property
    def probability(self) -> dict[str, float]:
        """{effect: probability that it acts at a size that matters}."""
        chance = dict.fromkeys(self.effects, 0.0)
        for explanation in self.explanations:
            shares = {}
            for cause, sizes in explanation.sizes.items():
                effect = LAG if cause == LATE else cause
                if effect in chance:
                    share = float(np.mean(self._sizes_that_matter(cause, *sizes) > 1.0))
                    shares[effect] = max(shares.get(effect, 0.0), share)
            for effect, share in shares.items():
                chance[effect] += explanation.weight * share
        return chance

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The effects that are likelier to act than not."""
        chance = self.probability
        return tuple(e for e in CARDS if chance.get(e, 0.0) > DECISION.least_probability)

    @cached_property
    def untestable(self) -> frozenset[str]:
        """Effects whose usual size these torques would not show."""
        precision = np.linalg.inv(self.estimate.covariance)
        shifts = {e: usual_shift(e, self.lags) for e in self.effects}
        testable = {
            e for e, q in shifts.items() if 0.5 * q @ precision @ q >= DECISION.standard_errors**2
        }
        return frozenset(TORQUES) - testable

    @cached_property
    def parameters(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """{named effect: mean and covariance of its parameters in theta}."""
        return {effect: self._parameters(effect, self._best) for effect in self.names}

    @cached_property
    def equivalent(self) -> dict[str, list[str]]:
        """{named effect: others in whose place these torques don't tell the
        difference}.
        """
        weights = {frozenset(e.sizes): e.weight for e in self.explanations}
        best = self._best.sizes
        out = {}
        for effect in self.names:
            rest = frozenset(cause for cause in best if _effects((cause,)) != {effect})
            rivals = (c.name for c in CAUSES if c.name not in {*best, effect, LATE})
            least = self._best.weight * np.exp(-DECISION.swap)
            alike = [c for c in rivals if weights.get(rest | {c}, 0.0) > least]
            alike += ["command_latency"] * (effect == LAG and LATE in best)
            if alike:
                out[effect] = sorted(alike)
        return out

    @cached_property
    def _best(self) -> Explanation:
        """The likeliest set that holds what is named."""
        return next(e for e in self.explanations if set(self.names) <= _effects(e.sizes))

    def with_thrust_of(self, theta: np.ndarray, effects: Collection[str]) -> "Torques":
        """The same beside the thrust of parameters theta (P,), of which these `effects`
        were named.
        """
        scaling = tuple(e for e in effects if CARDS[e].scales)
        if not scaling:
            return self
        slope = np.log(_thrust_slope(theta) / _thrust_slope(self.nominal))
        estimate = Estimate(
            NAMES, self.estimate.value + slope * ALIKE, self.estimate.covariance
        ).with_doubts(ALIKE[:, None], [SIZE["thrust_slope"]])
        # limits act before the lag: what is cut looks like a slow and weak motor
        if {"thrust_saturation", "thrust_curve"} & set(scaling):
            sizes = [SIZE["cut_phase"]] * 2 + [0.0] + [SIZE["cut_gain"]] * 3
            estimate = estimate.with_doubts(np.eye(len(NAMES)), sizes)
        return Torques(estimate, self.nominal, self.lags, self.effects)

    def _sizes_that_matter(self, cause: str, mean, covariance) -> np.ndarray:
        """(draws,) how large a cause is, in units of what begins to matter."""
        root = np.linalg.cholesky(covariance + 1e-12 * np.eye(len(mean)))
        size = mean + DRAWS[:, : len(mean)] @ root.T
        if cause == LATE:
            return size[:, 0] / DECISION.least_delay
        if cause == LAG:
            return np.max([self._response(size[:, k], k) for k in (0, 1)], 0) / DECISION.least_lag
        return np.abs(size).max(1) / DECISION.least_gain

    def _response(self, phase: np.ndarray, way: int) -> np.ndarray:
        """(draws,) by which share a rotor's response in BAND differs from the assumed
        one, with more phase (draws,) at TALKED_OF.
        """
        lag = _lag(self.lags[way], phase)
        ratio = (1.0 + 1j * BAND * self.lags[way]) / (1.0 + 1j * BAND * lag[:, None])
        return np.abs(ratio - 1.0).mean(1)

    def _parameters(self, effect: str, explanation: Explanation):
        """Mean and covariance of an effect's parameters, by a set that holds it."""
        start = self.nominal[[PLACE[effect, p.name] for p in CARDS[effect].fitted]]
        spread = np.array([p.spread for p in CARDS[effect].fitted])
        if effect == LAG:
            return self._lag_parameters(start, explanation.sizes)
        mean, covariance = explanation.sizes[effect]
        value = start.copy()
        value[: len(mean)] = start[: len(mean)] * np.exp(mean)
        slopes = value[: len(mean)]
        rest = np.diag(spread[len(mean) :] ** 2)
        return value, block_diag(covariance * np.outer(slopes, slopes), rest)

    def _lag_parameters(self, start: np.ndarray, sizes: dict):
        """The lag's: what a delay does beside it is more of it."""
        value = start.copy()
        covariance = np.eye(2) * 1e-8
        if LAG in sizes:
            mean, spread = sizes[LAG]
            lags = _lag(self.lags, mean)
            slopes = (1.0 + (TURN * lags) ** 2) / TURN
            value = value + lags - self.lags
            covariance = covariance + spread * np.outer(slopes, slopes)
        if LATE in sizes:
            value = value + sizes[LATE][0][0]
            covariance = covariance + sizes[LATE][1][0, 0]
        return value, covariance


def _effects(causes) -> set[str]:
    return {LAG if cause == LATE else cause for cause in causes}


def _columns(*rows: int) -> np.ndarray:
    return np.eye(len(NAMES))[:, rows]


CAUSES = (
    Cause(LAG, _columns(0, 1), np.array([[0.16, 0.12], [0.12, 0.16]]), CARDS[LAG].log_odds),
    Cause(LATE, _columns(2), np.array([[0.03**2]]), CARDS[LAG].log_odds),
    Cause(
        INERTIA,
        _columns(3, 4, 5) * np.array([1.0, 1.0, -1.0]),
        0.35**2 * (0.8 * np.ones((3, 3)) + 0.2 * np.eye(3)),
        CARDS[INERTIA].log_odds,
    ),
    Cause(YAW, _columns(5), np.array([[0.25]]), CARDS[YAW].log_odds),
)
"""Spreads cover what the effects' cards call usual: phases of lags up to 120 ms, moments
of .5 to 2 times the assumed ones.
"""


def usual_shift(effect: str, lags: np.ndarray) -> np.ndarray:
    """(n,) what an effect's usual size does to NAMES."""
    sample = CARDS[effect].sample
    if effect == LAG:
        more = np.array([sample["extra_up"], sample["extra_down"]])
        return _columns(0, 1) @ (np.arctan(TURN * (lags + more)) - np.arctan(TURN * lags))
    if effect == INERTIA:
        return np.log(sample["xx"]) * ALIKE
    return _columns(5)[:, 0] * np.log(sample["ratio"])


def torques_of(
    identification: Identification | None, baseline, vehicle, pwm: bool, absent: np.ndarray
) -> Torques | None:
    """Torques of a case beside the vehicle that has `absent` (P,) while
    nothing acts; None where they aren't trusted. Beside a `baseline` it is what changed
    since, so that what both sets of flights hide or have alike drops out.
    """
    if identification is None:
        return None
    reference = None if baseline is None else baseline.identification
    if reference is not None and comparable(identification, reference):
        start = np.concatenate([_extra(absent), np.exp(_assumed_gains(absent))])
        change = change_of(identification.estimates, reference.estimates, start)
        estimate = _estimate(change, absent, vehicle)
        return Torques(estimate, absent, _lags(absent, vehicle))
    if not identification.trustworthy:
        return None
    estimate = _usual(
        _estimate(_with_usual_damping(identification.estimates, vehicle), absent, vehicle), pwm
    )
    return Torques(estimate, absent, _lags(absent, vehicle))


def _lags(absent: np.ndarray, vehicle) -> np.ndarray:
    """(2,) s: time constants of speeding up and down that are assumed."""
    up = float(vehicle.motor_time_constant)
    nominal = np.array([up, up * float(vehicle.motor_slowdown_ratio)])
    return np.maximum(nominal + _extra(absent), 1e-3)


def _extra(theta: np.ndarray) -> np.ndarray:
    """(2,) s of parameters theta (P,)."""
    return np.array([theta[PLACE[LAG, p]] for p in ("extra_up", "extra_down")])


def _lag(lags: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Time constants with more phase (rad) at TALKED_OF."""
    return np.tan(np.clip(np.arctan(TURN * lags) + phase, 0.02, 1.54)) / TURN


def _estimate(estimates: EffectEstimates, absent: np.ndarray, vehicle) -> Estimate:
    """The estimates as NAMES, beside what is assumed."""
    extra = estimates.value[:2]
    gains = np.maximum(estimates.value[2:], LEAST_GAIN)
    nominal = _lags(np.zeros_like(absent), vehicle)
    lags = np.maximum(nominal + extra, 1e-3)
    phase = np.arctan(TURN * lags) - np.arctan(TURN * _lags(absent, vehicle))
    delay, delay_error = estimates.clock
    value = np.concatenate([phase, [delay], np.log(gains) - _assumed_gains(absent)])
    slopes = np.concatenate([TURN / (1.0 + (TURN * lags) ** 2), 1.0 / gains])
    covariance = np.zeros((len(NAMES), len(NAMES)))
    rows = [0, 1, 3, 4, 5]
    covariance[np.ix_(rows, rows)] = estimates.covariance * np.outer(slopes, slopes)
    covariance[2, 2] = delay_error**2 + SIZE["late_motors"] ** 2
    return Estimate(NAMES, value, covariance)


def _assumed_gains(theta: np.ndarray) -> np.ndarray:
    """(3,) logarithms of the gains that a vehicle of theta (P,) would show."""
    slope = _thrust_slope(theta)
    xx, yy, zz = (theta[PLACE[INERTIA, axis]] for axis in ("xx", "yy", "zz"))
    return np.log([xx / slope, yy / slope, theta[PLACE[YAW, "ratio"]] * slope / zz])


def _with_usual_damping(estimates: EffectEstimates, vehicle) -> EffectEstimates:
    """The estimates with the damping that rotors usually make: a lag, a gain and a
    damping trade places along a ridge. By how much the fitted damping is off says how
    far the model is, so all errors grow by its ratio (Birge 1932).
    """
    fit = estimates.fit
    rows = [6, 7]
    spread = fit.covariance[np.ix_(rows, rows)] + np.eye(2) * SIZE["damping_of_rotors"] ** 2
    gain = np.linalg.solve(spread, fit.covariance[rows]).T
    wrong = float(fit.value[rows] @ np.linalg.solve(spread, fit.value[rows])) / len(rows)
    usual = replace(
        fit,
        value=fit.value - gain @ fit.value[rows],
        covariance=max(1.0, wrong) * (fit.covariance - gain @ fit.covariance[rows]),
    )
    return of_fit(usual, vehicle)


def _usual(estimate: Estimate, pwm: bool) -> Estimate:
    """The estimate with what vehicles that nobody would call faulty differ by."""
    phase = np.sin(2.0 * np.arctan(TURN * 0.025)) / 2.0
    sizes = [SIZE["spin_up"] * phase, SIZE["spin_down"] * phase, 0.0]
    sizes += [SIZE["inertia"], SIZE["inertia"], SIZE["yaw"]]
    estimate = estimate.with_doubts(np.eye(len(NAMES)), sizes)
    ridge = np.array([phase / 0.025, phase / 0.025, 0.0, GAIN_OF_LAG, GAIN_OF_LAG, 0.0])
    estimate = estimate.with_doubts(
        np.stack([ridge, ALIKE], 1), [SIZE["lag_and_gain"], SIZE["duty_slope"] if pwm else 0.0]
    )
    return estimate.with_doubts(_columns(5), [SIZE["duty_yaw"] if pwm else 0.0])


def _thrust_slope(theta: np.ndarray) -> float:
    """By how many times the nominal slope thrust rises where vehicles hover."""

    def of(effect, parameter):
        return float(theta[PLACE[effect, parameter]])

    slope = of("thrust_curve", "slope") + 2.0 * HOVER * of("thrust_curve", "curvature")
    return max(slope * (1.0 + of("thrust_scale", "scale")), 0.1)
