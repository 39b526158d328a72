"""How far the gap shrinks: prediction errors on flights that the effects were not fitted to, before and
after.

The gap is the rms over channels of each channel's error divided by its noise floor. Errors are those of
short predictions from logged states: velocity over 0.25 s, body rates over 0.05 s, the pose against the
gyroscope over 0.1 s, the motor commands from the body-rate commands over a row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import smooth
from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit, fit_set, without_nuisances
from openjax.gap.replay import SKIP

METRIC = (
    "rms over channels of prediction error / noise floor on held-out flights (velocity over 0.25 s, "
    "body rates over "
    "0.05 s, pose against gyroscope over 0.1 s, motor commands from body-rate commands)"
)
HORIZONS = {"velocity": 0.25, "rates": 0.05, "pose": 0.1}  # s
BLOCK = 1.0  # s, unit of the bootstrap
DRAWS = 400
REFIT_STEPS = 2  # of Gauss-Newton for each flight left out, from the fit to all


@dataclass(frozen=True)
class Gap:
    """`before`, `after` and `floor` are in units of the noise floor (so `floor` is 1 where it is known).
    `reduction` is 1 - after / before; a negative one means that the named effects made held-out
    predictions worse."""

    metric: str
    before: float
    after: float
    floor: float
    reduction: float
    interval90: tuple[float, float]
    held_out: bool


def shrink(evidence: Evidence, after: list[np.ndarray], named) -> Gap:
    """The gap before and after the named effects: `after` are the physics' held-out residuals with them,
    the other paths go by name."""
    blocks = _blocks(evidence, after, tuple(named))
    before, left, floor = (_gap(blocks, kind) for kind in range(3))
    generator = np.random.default_rng(0)
    size = min(len(b[0]) for b in blocks.values())
    drawn = []
    for _ in range(DRAWS):
        pick = generator.integers(0, size, size)
        start = _gap(blocks, 0, pick)
        drawn.append(1.0 - _gap(blocks, 1, pick) / start)
    low, high = np.quantile(drawn, [0.05, 0.95])
    held_out = len(evidence.replay.flights) > 1
    reduction = 1.0 - left / before
    return Gap(
        METRIC,
        before,
        left,
        floor,
        reduction,
        (float(min(low, reduction)), float(max(high, reduction))),
        held_out,
    )


def _gap(blocks, kind: int, pick=None) -> float:
    levels = []
    for values in blocks.values():
        chosen = values[kind] if pick is None else values[kind][pick]
        levels.append(chosen.mean() / (values[2].mean() + 1e-18))
    return float(np.sqrt(np.mean(levels)))


def held_out_residuals(evidence: Evidence, fit: SetFit) -> list[np.ndarray]:
    """Residual (T, 9) of each track under the parameters fitted to the other flights, nuisances taken off."""
    replay = evidence.replay
    residuals = [column[0] for column in fit.columns]
    if len(fit.index) and len(replay.flights) > 1:
        for held in range(len(replay.flights)):
            theta = fit_set(replay.without_flight(held), fit.effects, fit.theta, REFIT_STEPS).theta
            for number in np.flatnonzero(replay.flight_of == held):
                residuals[number] = replay.measured[number] - replay.predict(theta[None], number)[0][0]
    return [without_nuisances(replay, r, k) for k, r in enumerate(residuals)]


def _blocks(evidence: Evidence, after, named) -> dict[str, list[np.ndarray]]:
    """channel -> mean squared errors of each block: [before, after, floor]."""
    nothing = held_out_residuals(evidence, evidence.nothing)
    blocks: dict[str, list[list[float]]] = {}

    def add(channel, kind, track, values):
        size = max(int(BLOCK / track.dt), 1)
        values = values[int(SKIP / track.dt) :]
        count = max(len(values) // size, 1)
        means = [float(np.mean(v)) for v in np.array_split(values, count)]
        blocks.setdefault(channel, [[], [], []])[kind].extend(means)

    groups = {"velocity": range(3, 6), "rates": range(3)}
    for number, track in enumerate(evidence.tracks):
        for kind, residual in enumerate((nothing[number], after[number], evidence.floor[number])):
            for group, axes in groups.items():
                if not evidence.replay.usable[axes[0]]:
                    continue
                step = max(round(HORIZONS[group] / track.dt), 1)
                error = residual[step:] - residual[:-step]
                for axis in axes:
                    add(f"{group} {'xyz'[axis % 3]}", kind, track, error[:, axis] ** 2)
        if evidence.pose is not None:
            step = max(round(HORIZONS["pose"] / track.dt), 1)
            known = (
                evidence.pose.residual[number] if "state_latency" in named else evidence.pose.before[number]
            )
            for kind, residual in enumerate(
                (evidence.pose.before[number], known, evidence.pose.residual[number])
            ):
                error = residual[step:] - residual[:-step]
                for axis in range(3):
                    add(f"pose {'xyz'[axis]}", kind, track, error[:, axis] ** 2)
        if evidence.rate_loop is not None:
            loop = evidence.rate_loop
            known = loop.residual[number] if "rate_gains" in named else loop.before[number]
            for kind, residual in enumerate((loop.before[number], known, loop.residual[number])):
                error = smooth(residual, 0.05, track.dt)
                for axis in range(3):
                    add(f"motors {'roll pitch yaw'.split()[axis]}", kind, track, error[:, axis] ** 2)
        if evidence.radio is not None:
            radio = evidence.radio
            used = tuple(e for e in ("command_latency", "packet_loss") if e in named)
            floor = 2e-3  # of thrust: below, the link is perfect for every purpose
            for kind, key in enumerate(((), used, ("command_latency", "packet_loss"))):
                value = radio.misfit[key] ** 2 + floor**2
                add("motors all", kind, track, np.full(len(track), value))
    return {c: [np.array(k) for k in v] for c, v in blocks.items()}
