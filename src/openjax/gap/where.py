"""The places of the gap, channel by regime, in units of the noise floor, before and after the named
effects.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from openjax.flights.regimes import REGIMES, regimes_of
from openjax.flights.track import smooth
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import ABSENT, places
from openjax.gap.model.replay import SKIP
from openjax.gap.residual import disturbances, residuals_of

CHANNELS = (
    "force_x",
    "force_y",
    "force_z",
    "torque_x",
    "torque_y",
    "torque_z",
    "estimator",
    "firmware",
)
CALM = 0.12  # s over which the rest is smoothed: sensor noise out, causes in


@dataclass(frozen=True)
class Place:
    """One cell of the table."""

    channel: str
    regime: str
    share: float
    """Part of the whole excess over the floor that lies here."""
    before: float
    """Rms in units of the noise floor, without the named effects."""
    after: float
    """The same with them."""
    seconds: float
    """Spent in the regime."""


def locate(evidence: Evidence, fit: SetFit, nothing: SetFit, effects=()) -> list[Place]:
    """The table, largest share first. `fit` is the physics part of the verdict,
    `nothing` the fit of no effect, `effects` all named effects.
    """
    names = [e for e in effects if e in fit.effects]
    masks = [{r: m[int(SKIP / t.dt) :] for r, m in regimes_of(t).items()} for t in evidence.tracks]
    inside = {r: np.concatenate([m[r] for m in masks]) for r in REGIMES}
    seconds = {r: int(m.sum()) * evidence.tracks[0].dt for r, m in inside.items()}
    places = []
    powers_of = _motion_powers(evidence, fit, names)
    if names:
        powers_of = without_nuisances(powers_of, _powers(evidence, residuals_of(nothing)))
    powers_of |= _other_powers(evidence, effects)
    for channel, powers in powers_of.items():
        floor = powers[2].mean() + 1e-18
        for regime in (r for r in REGIMES if seconds[r] >= DECISION.place_seconds):
            b, a = (float(p[inside[regime]].mean() / floor) for p in powers[:2])
            excess = max(b - 1.0, 0.0) * seconds[regime]
            places.append(Place(channel, regime, excess, b**0.5, a**0.5, seconds[regime]))
    total = sum(p.share for p in places) or 1.0
    return sorted((replace(p, share=p.share / total) for p in places), key=lambda p: -p.share)


def before_and_after(
    fit: SetFit, effects
) -> tuple[list[Float[np.ndarray, "_ channels"]], list[Float[np.ndarray, "_ channels"]]]:
    """Residuals (T, 9) of each track without some `effects` of a fit, all else as
    with them, and with them: the same before as the gap's.
    """
    residuals = residuals_of(fit)
    without = fit.theta.copy()
    place = places(effects)
    without[place] = ABSENT[place]
    predictions = fit.replay.predict(np.stack([fit.theta, without]))
    return [a + m[0] - m[1] for a, m in zip(residuals, predictions, strict=True)], residuals


def _motion_powers(evidence: Evidence, fit: SetFit, effects) -> dict[str, list[np.ndarray]]:
    """{channel: squared smoothed disturbances (rows,) before, after and at the
    floor}.
    """
    nominal, with_effects = (_powers(evidence, r) for r in before_and_after(fit, effects))
    # the motion's floor is what all effects leave of it
    return {name: [nominal[name], with_effects[name], with_effects[name]] for name in nominal}


def _powers(evidence: Evidence, residuals: list[np.ndarray]) -> dict[str, np.ndarray]:
    """{channel of the motion: squared smoothed disturbances (rows,)}."""
    rows = []
    for track, residual in zip(evidence.tracks, residuals, strict=True):
        rest = disturbances(track, residual)
        # without a path the accelerometer is all that feels a force
        force = rest[:, 3:6] if evidence.replay.usable[3] else rest[:, 6:9]
        calm = smooth(np.concatenate([force, rest[:, :3]], 1), CALM, track.dt)
        rows.append(calm[int(SKIP / track.dt) :] ** 2)
    return dict(zip(CHANNELS, np.concatenate(rows).T, strict=False))


def without_nuisances(
    powers_of: dict[str, list[np.ndarray]], of_nothing: dict[str, np.ndarray]
) -> dict[str, list[np.ndarray]]:
    """Powers before, after and at the floor without credit for what nuisances alone
    explain as well: where a fit of no effect leaves a gap, the channels in which it
    leaves none are none of the effects' places. Where nuisances take all of it, nothing
    tells their places from the effects'.
    """
    growth = {
        name: np.sqrt(of_nothing[name].mean() / (floor.mean() + 1e-18))
        for name, (_, _, floor) in powers_of.items()
    }
    if max(growth.values()) < DECISION.place_growth:
        return powers_of
    return {
        name: [of_nothing[name] if growth[name] < DECISION.place_growth else powers[0], *powers[1:]]
        for name, powers in powers_of.items()
    }


def _other_powers(evidence: Evidence, effects) -> dict[str, list[np.ndarray]]:
    """The same of pose, radio and rate loop: their squared residuals."""
    powers_of: dict[str, list[np.ndarray]] = {}
    for channel in evidence.channels:
        floor = channel.residuals(evidence.library.of(channel.path))
        scale = {}
        for name, series in floor.items():
            scale[name] = float(np.sqrt(np.mean(np.concatenate(series) ** 2))) + 1e-12
        powers = [
            _mean_squares(evidence, errors, scale)
            for errors in (channel.residuals(()), channel.residuals(effects), floor)
        ]
        name = "estimator" if channel.path == "estimator" else "firmware"
        if name in powers_of:  # radio and rate loop are both the firmware's
            powers = [a + b for a, b in zip(powers_of[name], powers, strict=True)]
        powers_of[name] = powers
    return powers_of


def _mean_squares(evidence: Evidence, errors: dict, scale: dict[str, float]) -> np.ndarray:
    """(rows,) mean over a channel's series of their squared errors, each in units of
    its scale.
    """
    rows = []
    for number, track in enumerate(evidence.tracks):
        ratios = [series[number] / scale[name] for name, series in errors.items()]
        mean = np.mean(np.square(ratios), 0)  # (T,), or (1,) of a whole flight
        rows.append(np.broadcast_to(mean, len(track))[int(SKIP / track.dt) :])
    return np.concatenate(rows)


def in_words(places: list[Place]) -> str:
    """The two largest cells as text."""
    words = {"force": "force along body", "torque": "torque about body"}
    parts = []
    for place in (p for p in places[:2] if p.share >= 0.02 and p.before >= DECISION.place_growth):
        kind, _, axis = place.channel.partition("_")
        name = f"{words[kind]} {axis}" if kind in words else place.channel
        regime = place.regime.replace("_", " ")
        parts.append(f"{name} in {regime} flight ({place.before:.1f} times the noise floor)")
    return "; ".join(parts) or "no channel stands out from the noise"
