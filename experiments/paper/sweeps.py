"""All methods over the capture radius and the evader's speed.

As in the paper's two figures: the radius in `empty`, the speed in `passage`; policies trained at
one radius and one speed fly at others.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.paper.roster import COLORS, METHODS, flights_of

RADII = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
SPEEDS = (1.0, 1.2, 1.3, 1.4, 1.6, 1.8, 2.0, 2.3, 2.6)
RADIUS = 0.3
SPEED = 1.3
"""Of the training."""
CELLS = (("empty", SPEED), *(("passage", speed) for speed in SPEEDS))
"""Layout and evader speed (m/s) of what is flown."""


def figures(flown: list[Any], length: int) -> dict:
    """Capture rate and step over the radii and over the speeds, of `Flights` for each of `CELLS`."""
    first = np.stack([part.first for part in flown])
    is_missed = first > length
    rate = np.round(1 - is_missed.mean(axis=1), 5)
    step = np.round(np.where(is_missed, length, first).mean(axis=1), 2)
    place = RADII.index(RADIUS)
    collisions = [float(np.mean(part.evaluation.statistics.collision_rate)) for part in flown[1:]]
    return {
        "radius": {"capture_rate": rate[0].tolist(), "capture_step": step[0].tolist()},
        "speed": {
            "capture_rate": rate[1:, place].tolist(),
            "capture_step": step[1:, place].tolist(),
            "collision_rate": np.round(collisions, 6).tolist(),
        },
    }


def seeds_by_method(results: dict) -> dict[str, list[dict]]:
    """The two sweeps of each method's seeds, with the clamp."""
    methods = {
        label: [flight["sweeps"] for flight in flights_of(results, label)] for label in METHODS
    }
    return {label: seeds for label, seeds in methods.items() if seeds}


def draw(results: dict, path: Path) -> None:
    """Capture rate and step over radius and over speed, mean and range over seeds."""
    methods = seeds_by_method(results)
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    swept = (
        ("radius", RADII, RADIUS, "capture radius in empty (m)"),
        ("speed", SPEEDS, SPEED, "evader speed in passage (m/s)"),
    )
    for j, (axis, x, own, label) in enumerate(swept):
        for i, name in enumerate(("capture_rate", "capture_step")):
            for method, seeds in methods.items():
                values = np.array([seed[axis][name] for seed in seeds])
                line = {"color": COLORS[method], "marker": "o", "markersize": 3, "label": method}
                axes[i, j].plot(x, values.mean(axis=0), **line)
                band = {"color": COLORS[method], "alpha": 0.15, "linewidth": 0}
                axes[i, j].fill_between(x, values.min(axis=0), values.max(axis=0), **band)
            axes[i, j].axvline(own, color="black", linewidth=0.8, linestyle=":")
            axes[i, j].grid(alpha=0.3)
            axes[i, 0].set_ylabel(name.replace("_", " "))
        axes[1, j].set_xlabel(label)
    axes[0, 0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    figure.savefig(path, dpi=100)
