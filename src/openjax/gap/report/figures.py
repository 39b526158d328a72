"""Pictures of a report."""

from __future__ import annotations

import base64
import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from openjax.flights.track import rotation, smooth
from openjax.gap.library import CARDS
from openjax.gap.report import Report
from openjax.gap.rest import disturbances, residuals_of
from openjax.gap.table import HORIZONS
from openjax.gap.where import CHANNELS, REGIMES


def pictures(report: Report) -> list[tuple[str, str]]:
    """(title, PNG in base64) of every picture that the report's arrays allow."""
    if not report.plots:
        return []
    drawn = (
        ("Shares of the gap", _shares),
        ("Where the gap lies", _where),
        ("A flight before and after", _overlay),
        ("The rest against the effect's own coordinate", _coordinate),
    )
    found = [(title, draw(report)) for title, draw in drawn]
    return [(title, _encoded(figure)) for title, figure in found if figure is not None]


def _encoded(figure) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=85, bbox_inches="tight")
    plt.close(figure)
    return base64.b64encode(data.getvalue()).decode()


def _where(report: Report):
    if not report.where:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.4), sharey=True)
    for axis, kind in zip(axes, ("before", "after"), strict=True):
        table = np.full((len(CHANNELS), len(REGIMES)), np.nan)
        for place in report.where:
            table[CHANNELS.index(place.channel), REGIMES.index(place.regime)] = getattr(place, kind)
        shown = axis.imshow(np.log2(np.maximum(table, 1.0)), vmin=0, vmax=4, cmap="YlOrRd", aspect="auto")
        for row in range(len(CHANNELS)):
            for column in range(len(REGIMES)):
                if np.isfinite(table[row, column]):
                    axis.text(column, row, f"{table[row, column]:.1f}", ha="center", va="center", fontsize=7)
        axis.set_xticks(
            range(len(REGIMES)), [r.replace("_", " ") for r in REGIMES], rotation=45, ha="right", fontsize=8
        )
        axis.set_yticks(range(len(CHANNELS)), [c.replace("_", " ") for c in CHANNELS], fontsize=8)
        axis.set_title(f"{kind}, in units of the noise floor", fontsize=10)
    figure.colorbar(shown, ax=axes, label="log2")
    return figure


def _shares(report: Report):
    """The split of the gap, and what it was and is."""
    parts = {
        **report.shares.effects,
        "sensors and clocks": report.shares.sensors,
        "unexplained": report.shares.unexplained,
    }
    names = list(parts)[::-1]
    values = np.array([parts[n].value for n in names])
    low, high = np.array([parts[n].interval90 for n in names]).T
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 0.6 + 0.45 * max(len(names), 4)))
    left.barh(names, values, xerr=[values - low, high - values], color="#2b6cb0", ecolor="#888")
    left.set_xlabel("share of the gap's square, 90 % interval")
    left.tick_params(labelsize=8)
    gap = report.gap
    right.bar(
        ["before", "after", "floor"], [gap.before, gap.after, gap.floor], color=["#c53030", "#2b6cb0", "#999"]
    )
    right.set_ylabel("gap, units of the floor")
    right.tick_params(labelsize=8)
    return figure


def _overlay(report: Report):
    evidence = report.plots["evidence"]
    track = evidence.tracks[-1]
    before = residuals_of(evidence.replay, evidence.nothing)[-1]
    after = residuals_of(evidence.replay, report.plots["selection"].fit)[-1]
    step = max(round(HORIZONS["velocity"] / track.dt), 1)
    axis = 3 + int(np.argmax([np.std(before[step:, 3 + a] - before[:-step, 3 + a]) for a in range(3)]))
    if not evidence.replay.usable[3]:
        axis = 2
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 2.8), width_ratios=(2, 1))
    time = track.time[step:]
    for residual, colour, label in (
        (before, "#c53030", "nominal"),
        (after, "#2b6cb0", "with the named effects"),
    ):
        left.plot(time, residual[step:, axis] - residual[:-step, axis], color=colour, lw=0.9, label=label)
    band = 1.645 * np.std(after[step:, axis] - after[:-step, axis])
    left.axhspan(-band, band, color="#999", alpha=0.3, lw=0, label="90 % of what is left")
    left.set_xlabel("s")
    unit = "m/s" if axis >= 3 else "rad/s"
    left.set_ylabel(
        f"{'velocity' if axis >= 3 else 'rate'} {'xyz'[axis % 3]}, error after "
        f"{HORIZONS['velocity']} s, {unit}"
    )
    left.legend(fontsize=8)
    rows = [max(round(h / track.dt), 1) for h in (0.02, 0.05, 0.1, 0.25, 0.5, 1.0)]
    for residual, colour in ((before, "#c53030"), (after, "#2b6cb0")):
        right.loglog(
            [r * track.dt for r in rows],
            [np.std(residual[r:, axis] - residual[:-r, axis]) for r in rows],
            "o-",
            color=colour,
            ms=3,
        )
    right.set_xlabel("horizon, s")
    right.set_ylabel(f"rms error, {unit}")
    return figure


def _coordinate(report: Report):
    """Force along the effect's channel against the variable that drives it, binned, before and after."""
    evidence = report.plots["evidence"]
    effect = next((e for e in report.effects if e != "unknown"), None)
    if effect is None or not evidence.replay.usable[3] or evidence.tracks[0].quaternion is None:
        return None
    coordinate = CARDS[effect].coordinate
    points = {0: [], 1: []}
    for kind, residuals in enumerate(
        residuals_of(evidence.replay, f) for f in (evidence.nothing, report.plots["selection"].fit)
    ):
        for number, residual in enumerate(residuals):
            track = evidence.tracks[number]
            rest = smooth(disturbances(track, residual), 0.12, track.dt)[:, 3:6]
            if coordinate == "body velocity":
                x = np.einsum("tji,tj->ti", rotation(track.quaternion), track.velocity)[:, 0]
                y = rest[:, 0]
            else:
                y = rest[:, 2]
                x = {
                    "height": track.position[:, 2],
                    "thrust": smooth(track.motor.mean(1), 0.05, track.dt),
                    "voltage": track.voltage if track.voltage is not None else track.time,
                }.get(coordinate)
                if coordinate == "height below a neighbour":
                    if not len(track.neighbours):
                        continue
                    x = track.neighbours[0][:, 2] - track.position[:, 2]
            points[kind].append(np.stack([x, y], 1)[20:])
    if not points[0]:
        return None
    figure, axis = plt.subplots(figsize=(6, 3))
    for kind, colour, label in ((0, "#c53030", "nominal"), (1, "#2b6cb0", "with the named effects")):
        data = np.concatenate(points[kind])
        edges = np.quantile(data[:, 0], np.linspace(0, 1, 16))
        bins = np.clip(np.searchsorted(edges, data[:, 0]) - 1, 0, 14)
        middle = [data[bins == b].mean(0) if (bins == b).any() else (np.nan, np.nan) for b in range(15)]
        axis.plot(*np.array(middle).T, "o-", color=colour, ms=3, label=label)
    units = {"body velocity": " x, m/s", "voltage": ", V", "thrust": ", mean motor command"}
    axis.set_xlabel(coordinate + units.get(coordinate, ", m"))
    axis.set_ylabel("unexplained acceleration, m/s²")
    axis.legend(fontsize=8)
    return figure
