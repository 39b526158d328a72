"""How the gap splits: what each accepted effect, the sensors and the unexplained rest take of it, on stretches that no
parameter was fitted to.

The gap is the rms over channels of each channel's prediction error over its floor: velocity over 0.25 s, body rates
over 0.05 s, the pose against the gyroscope over 0.1 s, the motor commands from the body-rate commands. The floor is what
is left with all accepted effects once a flexible model has taken what follows anything in the log: sensor noise and
gusts. A share is the growth of the gap's square when one part goes and all others stay, over the whole of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import smooth
from openjax.gap.evidence import Evidence
from openjax.gap.judging import keep
from openjax.gap.replay import SKIP
from openjax.gap.rest import Rest
from openjax.gap.selection import LEAST_GAIN, Selection
from openjax.gap.table import ERRORS, with_effects

METRIC = (
    "rms over channels of prediction error / noise floor on stretches left out (velocity over 0.25 s, body rates over "
    "0.05 s, pose against gyroscope over 0.1 s, motor commands from body-rate commands)"
)
POSE_HORIZON = 0.1  # s
THRUST_FLOOR = 2e-3  # of thrust: below, the link is perfect for every purpose
# Nuisances that are the sensors' and the clocks': how they are mounted, biased, filtered and timed.
SENSORS = (
    "frame tilt",
    "level of the world",
    "IMU tilt",
    "accelerometer",
    "gyroscope's low-pass",
    "clock of",
)
DRAWS = 400  # of the bootstrap over seconds of flight


@dataclass(frozen=True)
class Share:
    """Part of the gap's square, with its 90 % interval."""

    value: float
    interval90: tuple[float, float]


@dataclass(frozen=True)
class Gap:
    """`before` (no effect; sensors and clocks as the flights show them), `after` and `floor`, in units of the floor;
    `reduction` is 1 - after / before."""

    metric: str
    before: float
    after: float
    floor: float
    reduction: float
    interval90: tuple[float, float]
    held_out: bool


@dataclass(frozen=True)
class Split:
    """`effects` {name: Share}; `sensors`: sensors and clocks; `unexplained`: what follows something in the log but no
    accepted effect; `channels` {name: (before, after)} rms in units of its floor."""

    gap: Gap
    effects: dict[str, Share]
    sensors: Share
    unexplained: Share
    channels: dict[str, tuple[float, float]]


def split(evidence: Evidence, selection: Selection, rest: Rest, named) -> Split:
    """Shares of the `named` effects, of all paths."""
    named = tuple(named)
    physics = [e for e in named if e in selection.fit.effects]
    states = {"all": _squares(evidence, selection, physics, named)}
    states["before"] = _squares(evidence, selection, (), ())
    states["raw"] = _squares(evidence, selection, (), (), sensors=False)
    states["plain"] = _squares(evidence, selection, physics, named, sensors=False)
    for effect in named:
        others = [e for e in named if e != effect]
        states[effect] = _squares(evidence, selection, [e for e in physics if e != effect], others)
    names = list(states["all"])
    left = {k: np.stack([v[n] for n in names], 1) for k, v in states.items()}
    predicted = np.array(
        [rest.everything.predicted[ERROR_NAMES.index(n)] if n in ERROR_NAMES else 0.0 for n in names]
    )
    rows = left["all"].shape[0]

    def power(kind, pick, floor):
        return float(np.mean(left[kind][pick].mean(0) / floor))

    def measure(pick):
        floor = left["all"][pick].mean(0) * (1.0 - predicted) + 1e-30
        value = {k: power(k, pick, floor) for k in left}
        whole = max(value["raw"], value["before"]) - 1.0
        # Without a gap there is nothing to share.
        scale = 1.0 / whole if whole > 2.0 * LEAST_GAIN else 0.0
        parts = {e: scale * (value[e] - value["all"]) for e in named}
        parts["sensors"] = scale * max(value["plain"] - value["all"], 0.0)
        parts["unexplained"] = scale * (value["all"] - 1.0)
        return parts, value

    everything = np.arange(rows)
    parts, value = measure(everything)
    generator, drawn = np.random.default_rng(0), []
    for _ in range(DRAWS):
        own, level = measure(generator.integers(0, rows, rows))
        drawn.append([*own.values(), 1.0 - np.sqrt(level["all"] / level["before"])])
    low, high = np.quantile(np.array(drawn), [0.05, 0.95], axis=0)
    shares = {
        k: Share(float(v), (float(min(a, v)), float(max(b, v))))
        for (k, v), a, b in zip(parts.items(), low, high, strict=False)
    }
    reduction = 1.0 - np.sqrt(value["all"] / value["before"])
    gap = Gap(
        METRIC,
        float(np.sqrt(value["before"])),
        float(np.sqrt(value["all"])),
        1.0,
        float(reduction),
        (float(min(low[-1], reduction)), float(max(high[-1], reduction))),
        len(evidence.replay.flights) > 1,
    )
    floor = left["all"].mean(0) * (1.0 - predicted) + 1e-30
    channels = {
        n: (
            float(np.sqrt(left["before"][:, k].mean() / floor[k])),
            float(np.sqrt(left["all"][:, k].mean() / floor[k])),
        )
        for k, n in enumerate(names)
    }
    return Split(gap, {e: shares[e] for e in named}, shares["sensors"], shares["unexplained"], channels)


ERROR_NAMES = tuple(n for n, _ in ERRORS)


def _squares(evidence: Evidence, selection: Selection, physics, named, sensors=True) -> dict[str, np.ndarray]:
    """{channel: (B,) mean squared errors by second of flight} with the effects `physics` of the selection's and those
    of `named` that act on other paths; `sensors`: with what sensors and clocks take within their bounds, or without."""
    table = selection.table
    # Numbers of the vehicle and what feedback makes of gusts are no sensor's fault and no effect: they stay.
    off = None if sensors else np.array([n.startswith(SENSORS) for n in evidence.replay.nuisance_names])
    drop = tuple(e for e in selection.fit.effects if e not in physics and e not in evidence.feigned)
    squares = keep(table, with_effects(table), drop, off) / table.rows[:, None]
    out = {n: squares[:, k] for k, (n, _) in enumerate(ERRORS) if table.usable[k] > 0}
    counts = [int((table.track_of == k).sum()) for k in range(len(evidence.tracks))]

    def blocks(values):
        return np.concatenate(
            [[b.mean(0) for b in np.array_split(v, n)] for v, n in zip(values, counts, strict=True)]
        )

    skips = [int(SKIP / t.dt) for t in evidence.tracks]
    if evidence.pose is not None:
        used = evidence.pose.residual if "state_latency" in named else evidence.pose.before
        steps = [max(round(POSE_HORIZON / t.dt), 1) for t in evidence.tracks]
        errors = [(r[n:] - r[:-n])[s:] ** 2 for r, n, s in zip(used, steps, skips, strict=True)]
        out |= {f"pose {a}": v for a, v in zip("xyz", blocks(errors).T, strict=True)}
    if evidence.rate_loop is not None:
        used = evidence.rate_loop.residual if "rate_gains" in named else evidence.rate_loop.before
        errors = [
            smooth(r, 0.05, t.dt)[s:] ** 2 for r, t, s in zip(used, evidence.tracks, skips, strict=True)
        ]
        out |= {f"motors {a}": v for a, v in zip(("roll", "pitch", "yaw"), blocks(errors).T, strict=True)}
    if evidence.radio is not None:
        key = tuple(e for e in ("command_latency", "packet_loss") if e in named)
        misfit = evidence.radio.misfit[key]
        out["motors all"] = np.full(len(table.rows), misfit**2 + THRUST_FLOOR**2)
    return out
