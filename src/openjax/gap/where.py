"""Where the gap lies: channel by regime, in units of the noise floor, before and after the named effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track, smooth
from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit
from openjax.gap.replay import SKIP
from openjax.gap.rest import disturbances, residuals_of

CHANNELS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z", "estimator", "firmware")
REGIMES = (
    "hover",
    "fast",
    "climb",
    "low",
    "high",
    "under_neighbour",
    "low_battery",
    "high_thrust",
    "transient",
)
LEAST_TIME = 0.5  # s in a regime, or it isn't judged
CALM = 0.12  # s over which the rest is smoothed: sensor noise out, causes in


@dataclass(frozen=True)
class Place:
    """One cell of the table. `before` and `after` are rms in units of the noise floor; `share` is the part
    of the whole excess over the floor that lies here; `seconds` the time spent in the regime."""

    channel: str
    regime: str
    share: float
    before: float
    after: float
    seconds: float


def regimes_of(track: Track) -> dict[str, np.ndarray]:
    """Masks (T,) of the regimes; a row may be in several."""
    rows = len(track)
    never = np.zeros(rows, bool)
    collective = smooth(track.motor.mean(1), 0.05, track.dt)
    change = np.abs(np.gradient(smooth(track.motor, 0.03, track.dt), track.dt, axis=0)).max(1)
    masks = {r: never for r in REGIMES}
    masks["high_thrust"] = track.motor.max(1) > 0.8
    masks["transient"] = change > max(1.0, float(np.quantile(change, 0.8)))
    if track.velocity is not None:
        speed = np.linalg.norm(track.velocity[:, :2], axis=1)
        masks["hover"] = (speed < 0.3) & (np.abs(track.velocity[:, 2]) < 0.2)
        masks["fast"] = speed > 0.7
        masks["climb"] = np.abs(track.velocity[:, 2]) > 0.3
    if track.position is not None:
        masks["low"] = track.position[:, 2] < 0.15
        masks["high"] = track.position[:, 2] > 1.05
        for other in track.neighbours:
            gap = other - track.position
            near = (gap[:, 2] > 0.05) & (np.hypot(gap[:, 0], gap[:, 1]) < 0.2)
            masks["under_neighbour"] = masks["under_neighbour"] | near
    if track.voltage is not None:
        masks["low_battery"] = track.voltage < 3.5
    masks["high_thrust"] = masks["high_thrust"] | (collective > 0.8)
    return masks


def locate(evidence: Evidence, fit: SetFit, named=()) -> list[Place]:
    """The table, largest share first. `fit` is the physics part of the verdict, `named` all named effects."""
    before, after, floor = (_powers(evidence, r) for r in (evidence.nothing, fit, fit))
    paths = _other_paths(evidence, named)
    cells, total = [], 0.0
    masks = [{r: m[int(SKIP / t.dt) :] for r, m in regimes_of(t).items()} for t in evidence.tracks]
    for number, channel in enumerate(CHANNELS):
        if number < 6:
            columns = [[p[k][:, number] for k in range(len(p))] for p in (before, after, floor)]
        elif channel in paths:
            columns = paths[channel]
        else:
            continue
        level = np.mean(np.concatenate(columns[2])) + 1e-18
        for regime in REGIMES:
            inside = [m[regime] for m in masks]
            count = sum(int(i.sum()) for i in inside)
            seconds = count * evidence.tracks[0].dt
            if seconds < LEAST_TIME:
                continue
            b, a = (
                float(sum(c[i].sum() for c, i in zip(column, inside, strict=True)) / count / level)
                for column in columns[:2]
            )
            excess = max(b - 1.0, 0.0) * seconds
            total += excess
            cells.append((channel, regime, excess, np.sqrt(b), np.sqrt(a), seconds))
    places = [
        Place(c, r, float(e / total) if total > 0 else 0.0, float(b), float(a), float(s))
        for c, r, e, b, a, s in cells
    ]
    return sorted(places, key=lambda p: -p.share)


def _powers(evidence: Evidence, fit: SetFit) -> list[np.ndarray]:
    """Squared smoothed disturbances (T', 6) per track: force then torque channels."""
    residuals = residuals_of(evidence.replay, fit)
    out = []
    for track, residual in zip(evidence.tracks, residuals, strict=True):
        rest = disturbances(track, residual)
        force = rest[:, 3:6] if evidence.replay.usable[3] else rest[:, 6:9]
        calm = smooth(np.concatenate([force, rest[:, :3]], 1), CALM, track.dt)[int(SKIP / track.dt) :]
        out.append(calm**2)
    return out


def _other_paths(evidence: Evidence, named) -> dict[str, list]:
    """Squared residuals before, after and at the floor, per track, of estimator and firmware."""
    skips = [int(SKIP / t.dt) for t in evidence.tracks]
    found = {}
    for channel, path, effect in (
        ("estimator", evidence.pose, "state_latency"),
        ("firmware", evidence.rate_loop, "rate_gains"),
    ):
        if path is None:
            continue

        def power(residuals, path=path):
            scale = np.concatenate(path.residual).std(0) + 1e-12
            return [
                (((r - r.mean(0)) / scale)[s:] ** 2).mean(1) for r, s in zip(residuals, skips, strict=True)
            ]

        after = path.residual if effect in named else path.before
        found[channel] = [power(path.before), power(after), power(path.residual)]
    if evidence.radio is not None and "firmware" in found:
        radio = evidence.radio
        used = tuple(sorted(e for e in named if e in ("command_latency", "packet_loss")))
        floor = radio.misfit[("command_latency", "packet_loss")] + 1e-3
        for k, key in ((0, ()), (1, used)):
            extra = (radio.misfit[key] / floor) ** 2
            found["firmware"][k] = [p + extra for p in found["firmware"][k]]
        found["firmware"][2] = [p + 1.0 for p in found["firmware"][2]]
    return found


def in_words(places: list[Place]) -> str:
    """The two largest cells as text."""
    words = {"force": "force along body", "torque": "torque about body"}
    parts = []
    for place in places[:2]:
        if place.share < 0.02 or place.before < 1.15:
            continue
        kind, _, axis = place.channel.partition("_")
        name = f"{words[kind]} {axis}" if kind in words else place.channel
        parts.append(
            f"{name} in {place.regime.replace('_', ' ')} flight ({place.before:.1f} times the noise floor)"
        )
    return "; ".join(parts) or "no channel stands out of the noise"
