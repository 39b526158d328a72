"""A test of what the chosen effects leave unexplained: is it more than sensors, air and errors of
form leave?

Things that should agree are held against each other: measured motion and replay,
attitude and gyroscope, path and accelerometer, position and velocity. How much is left
of each, given what is left of the others, is told in standard deviations of cases of
several worlds in which nothing unknown acts. The p-value of the largest is conformal
over those (Vovk et al. 2005; `residual.json`).
"""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from openjax.flights.shapes import Chosen
from openjax.flights.track import Track, specific_force_of, to_body
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.hypotheses import SetFit, without_nuisances
from openjax.gap.model.nuisances import SIZE
from openjax.gap.model.replay import FORCE, RATES, SKIP, VELOCITY
from openjax.gap.shapes import Rows

# s over which each residual is let add up, and what is said where it is large.
HORIZONS = {
    "velocity": (0.5, "forces are left over"),
    "rates": (0.5, "torques are left over"),
    "accelerometer": (0.5, "path and accelerometer disagree"),
    "estimator": (0.1, "attitude and gyroscope disagree"),
    "position": (0.1, "position and velocity disagree"),
}
# Of HORIZONS what forces and torques leave, and so what another vehicle's gusts shake;
# where there are any, rows under it don't count.
OF_MOTION = ("velocity", "rates")
CALIBRATION = Path(__file__).with_name("residual.json")


@dataclass(frozen=True)
class Check:
    """`measures` {name: value} and the one that stands out most, `finding`; its
    `p_value` among cases without an unknown cause; `excess` (9,): share of each motion
    channel's squared error beyond what such cases leave, where the check rejects;
    `reference`: the measures that the reference leaves and that can be compared, None
    without one; `mostly_unknown`: whether it does, and effects of the motion explain little of what
    it finds.
    """

    measures: dict[str, float]
    finding: str
    p_value: float
    excess: np.ndarray
    reference: dict[str, float] | None = None
    mostly_unknown: bool = False
    by_reference: bool = False
    """True if what stands out most was compared with the reference: of forces and torques
    it can't be where a battery that nobody logged may have changed them.
    """

    @property
    def level(self) -> float:
        """Share of cases without an unknown cause that may be rejected."""
        return rejection_level(self.by_reference)

    @property
    def rejects(self) -> bool:
        """True if more than noise is left."""
        return self.p_value <= self.level

    @property
    def probability(self) -> float:
        """That something acts which no effect explains: the odds are a power of the
        level over the p-value, the likeliest over cases with known answers (a logistic
        calibration, Platt 1999).
        """
        return 1.0 / (1.0 + (self.p_value / self.level) ** DECISION.unknown_odds)

    def in_words(self) -> str:
        """A sentence on what is left."""
        return (
            f"The remaining error isn't noise (p = {self.p_value:.2g}): {self.finding}."
            if self.rejects
            else ""
        )


def check_residual(evidence: Evidence, fit: SetFit, nothing: SetFit) -> Check:
    """Check that a fit leaves no more than cases without an unknown cause do; `nothing` is the fit
    of no effect.
    """
    changes = _changes(evidence, residuals_of(fit))
    measures, axes = _spreads(changes)
    reference = None if evidence.baseline is None else _comparable(evidence)
    p_value, name = conformal_p(measures, reference)
    by_reference = reference is not None and name in reference
    mostly_unknown = False
    if reference:
        # with its mean, which a steady wind makes
        squares, squares_of_nothing = (
            {n: (c**2).mean(0).max() for n, c in of.items()}
            for of in (changes, _changes(evidence, residuals_of(nothing)))
        )
        shares = [
            unexplained_share(squares[n], reference[n] ** 2, squares_of_nothing[n])
            for n in _larger(measures, reference, name)
        ]
        mostly_unknown = max(shares, default=0.0) > DECISION.rest_share
    finding = HORIZONS.get(name, (0.0, ""))[1]
    check = Check(measures, finding, p_value, np.zeros(9), reference, by_reference=by_reference)
    if not check.rejects:
        return check
    excess = beyond(axes, reference or {})
    return replace(check, excess=excess, mostly_unknown=mostly_unknown)


def residuals_of(fit: SetFit) -> list[Float[np.ndarray, "_ channels"]]:
    """Residual (T, 9) of each track under a fit, nuisances taken off."""
    return [
        without_nuisances(fit.replay, column[0], number)
        for number, column in enumerate(fit.columns)
    ]


def disturbances(track: Track, residual: Rows) -> Rows:
    """A residual as accelerations (T, 9): angular (body), linear (body, from the
    velocity), specific force (body).
    """
    out = np.zeros_like(residual)
    out[:, RATES] = np.gradient(residual[:, RATES], track.dt, axis=0)
    out[:, VELOCITY] = np.gradient(residual[:, VELOCITY], track.dt, axis=0)
    if track.quaternion is not None:
        out[:, VELOCITY] = to_body(track.quaternion, out[:, VELOCITY])
    out[:, FORCE] = residual[:, FORCE]
    return out


def measure(
    evidence: Evidence, residuals: list[Float[np.ndarray, "_ channels"]]
) -> tuple[dict[str, float], dict[str, Float[np.ndarray, " 3"]]]:
    """{name: measure} of what is left, and {name: (3,) the same by axis}, of which a
    measure is the largest.
    """
    return _spreads(_changes(evidence, residuals))


def _spreads(changes: dict[str, np.ndarray]) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """As `measure`, of what `_changes` tells."""
    axes = {name: change.std(0) for name, change in changes.items()}
    return {name: float(size.max()) for name, size in axes.items()}, axes


def _changes(evidence: Evidence, residuals: list[np.ndarray]) -> dict[str, np.ndarray]:
    """{name of HORIZONS: by how much (rows, 3) what is left changes over its horizon}."""
    dt = evidence.tracks[0].dt
    skip = int(SKIP / dt)
    out = {}
    for name, parts in _series(evidence, residuals).items():
        step = max(round(HORIZONS[name][0] / dt), 1)
        changes = [(p[step:] - p[:-step])[skip:] for p in parts]
        if name in OF_MOTION and evidence.motion.gusts is not None:
            calm = [_calm(rows, step)[skip:] for rows in evidence.motion.gusts.rows]
            changes = [m[c] for m, c in zip(changes, calm, strict=True)]
        out[name] = np.concatenate(changes)
    return out


def _calm(rows: Chosen, step: int) -> Chosen:
    """(T - step,) whether none of the rows from each one to the one a step later is
    chosen.
    """
    count = np.concatenate([[0], np.cumsum(rows)])
    return count[step + 1 :] == count[: -step - 1]


def beyond(axes: dict[str, np.ndarray], reference: dict[str, float]) -> np.ndarray:
    """(9,) by which share the motion channels' squares exceed what the same vehicle's
    `reference` leaves, or else what the calibration's cases leave at most.
    """
    out = np.zeros(9)
    for name, channels in (("rates", RATES), ("velocity", VELOCITY)):
        if name in axes:
            usual = [c[name] for c in calibration() if name in c]
            most = reference.get(name, np.quantile(usual, 1.0 - DECISION.unknown))
            out[channels] = 1.0 - np.minimum(most / axes[name], 1.0) ** 2
    return out


def _series(evidence: Evidence, residuals: list[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """{name of HORIZONS: what is left (T, 3) of each track, added up} of what was
    logged.
    """
    usable = evidence.replay.usable
    tracks = evidence.replay.tracks
    motion = {"rates": RATES, "velocity": VELOCITY}
    out = {n: [r[:, axes] for r in residuals] for n, axes in motion.items() if usable[axes.start]}
    out |= {c.path: c.fit.residual for c in evidence.channels if c.path in HORIZONS}
    if all(t.position is not None and t.velocity is not None for t in tracks):
        out["position"] = [
            # the trapezoidal rule: of the last row half counts
            t.position - (np.cumsum(t.velocity, 0) - 0.5 * t.velocity) * t.dt
            for t in tracks
        ]
        has_force = all(t.specific_force is not None and t.quaternion is not None for t in tracks)
        if has_force and evidence.sensors.one_clock:
            out["accelerometer"] = [_path_against_accelerometer(t) for t in tracks]
    return out


def _path_against_accelerometer(track: Track) -> np.ndarray:
    """Velocity (T, 3) body axes by which the accelerometer and the path's acceleration
    come apart, its bias aside.
    """
    apart = track.specific_force - specific_force_of(track.quaternion, track.velocity, track.dt)
    return np.cumsum(apart - apart.mean(0), 0) * track.dt


def _comparable(evidence: Evidence) -> dict[str, float]:
    """The reference's measures, of which those of forces and torques say nothing where
    a battery that nobody logged makes another thrust of every duty cycle, and those of
    the pose nothing where it was moved in time by other times: of the path that counts
    where the case's is later.
    """
    baseline = evidence.baseline
    silent = OF_MOTION if evidence.charge_unknown else ()
    channels = {c.path: c for c in evidence.channels}
    shift = _shift(channels.get("estimator"))
    reference_shift = _shift(baseline.channels.get("estimator"))
    # What is late also jitters, which no shift takes away.
    if abs(shift - reference_shift) > DECISION.nuisance_bound * SIZE["pose_clock"]:
        silent += ("estimator", "accelerometer")
        silent += ("position",) if shift > reference_shift else ()
    return {n: v for n, v in baseline.measures.items() if n not in silent}


def _shift(pose) -> float:
    """By what time (s) the pose was moved before anything was held against it."""
    return pose.fit.value if pose is not None and pose.acting() else 0.0


def _larger(measures: dict[str, float], reference: dict[str, float], finding: str) -> list[str]:
    """The force or torque of which more is left than in the reference: the one that stands out
    most, also beside sensors that disagree, which by themselves are no rival of a force or torque.
    """
    days = dict(zip(HORIZONS, difference_of_days(), strict=True))
    return [
        n
        for n in OF_MOTION
        if n in measures
        and n in reference
        and (n == finding or np.log(measures[n] / reference[n]) > DECISION.clear_errors * days[n])
    ]


def unexplained_share(square: float, reference: float, of_nothing: float) -> float:
    """Share of what a mean square has grown by since the reference that the fit
    leaves.
    """
    remaining = square - reference
    return remaining / max(of_nothing - reference, remaining, 1e-24)


def rejection_level(by_reference: bool) -> float:
    """Share of cases without an unknown cause that may be rejected: by a measure that was
    held against a reference, or by another one.
    """
    return DECISION.unknown_with_reference if by_reference else DECISION.unknown


def conformal_p(
    measures: dict[str, float], reference: dict[str, float] | None = None
) -> tuple[float, str]:
    """Share of cases without an unknown cause, this one among them, that stand out as
    much, and by which measure this one does. `reference`: what the same vehicle's
    reference leaves, None without one. Beyond the largest the tail is exponential, as
    long as that of the upper quarter (Pickands 1975).
    """
    value, name = standing_out(measures, reference)
    others = calibration_values(reference is not None)
    share = float((1 + (others >= value).sum()) / (1 + len(others)))
    start = np.quantile(others, 0.75)
    scale = max(float((others[others >= start] - start).mean()), 1e-9)
    return share * float(np.exp(-max(value - others.max(), 0.0) / scale)), name


@cache
def calibration_values(with_reference: bool) -> np.ndarray:
    """(cases,) how far each of the calibration's cases stands out, with its reference
    or without.
    """
    if with_reference:
        pairs = calibration("with_reference")
        far = [standing_out(pair["case"], pair["reference"])[0] for pair in pairs]
    else:
        far = [standing_out(case)[0] for case in calibration()]
    return np.array(far)


def standing_out(
    measures: dict[str, float], reference: dict[str, float] | None = None
) -> tuple[float, str]:
    """The largest distance of one of a case's measures from what is expected, in standard
    deviations, and that measure. Logs without anything to compare stand out nowhere.

    What makes a sensor noisy raises all that it has a part in; so each logarithm is
    expected given the others, as of a normal distribution. What the `reference` leaves
    of the same measure is a second expectation. It counts by how little two sets of
    flights of one vehicle differ: other air and other manoeuvres shake forces and
    torques, and hardly a sensor.
    """
    names, (mean, covariance) = list(HORIZONS), usual()
    logs = logarithms(measures)
    rows = np.flatnonzero(np.isfinite(logs))
    # with precision P of a normal distribution, (P r)_k / P_kk is how far r_k is from
    # what the others lead to expect, with a variance of 1 / P_kk
    precision = np.linalg.inv(covariance[np.ix_(rows, rows)])
    weight = np.diag(precision)
    off = precision @ (logs - mean)[rows] / weight
    if reference is not None:
        growth = (logs - logarithms(reference))[rows]
        more = np.isfinite(growth) / difference_of_days()[rows] ** 2
        off = (weight * off + more * np.nan_to_num(growth)) / (weight + more)
        weight = weight + more
    far = (off * np.sqrt(weight)).tolist()
    return max(zip(far, (names[k] for k in rows), strict=True), default=(-np.inf, ""))


def logarithms(measures: dict[str, float]) -> np.ndarray:
    """(measures,) in the order of HORIZONS, NaN where there is none."""
    return np.log([max(measures[n], 1e-12) if n in measures else np.nan for n in HORIZONS])


@cache
def calibration(kind: str = "cases") -> list[dict]:
    """The measures of cases without an unknown cause; of the kind "with_reference" the
    same of others, each a {"case", "reference"} with what its reference leaves.
    """
    return json.loads(CALIBRATION.read_text(encoding="utf-8"))[kind]


@cache
def usual() -> tuple[np.ndarray, np.ndarray]:
    """Mean (measures,) and covariance (measures, measures) of the logarithms over the
    calibration's cases that have them.
    """
    logs = np.ma.masked_invalid([logarithms(case) for case in calibration()])
    return logs.mean(0).filled(0.0), np.ma.cov(logs, rowvar=False).filled(0.0)


@cache
def difference_of_days() -> np.ndarray:
    """(measures,) root mean squares of what the logarithms grow by from a reference to
    a case without an unknown cause.
    """
    pairs = calibration("with_reference")
    growth = [logarithms(p["case"]) - logarithms(p["reference"]) for p in pairs]
    return np.sqrt(np.nanmean(np.square(growth), axis=0))
