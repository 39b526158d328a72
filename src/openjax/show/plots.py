"""Pictures of a run: trajectories from above, and training curves. Drawn without a
display.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from openjax.files import replacing
from openjax.show.metrics import read_metrics
from openjax.show.trajectory import Trajectory

PURSUER_COLORS = (
    "tab:blue",
    "tab:green",
    "tab:purple",
    "tab:cyan",
    "tab:olive",
    "tab:brown",
    "navy",
    "teal",
)
EVADER_COLOR = "tab:red"

_CURVES = (
    ("capture_rate", "capture rate"),
    ("episode_return", "return"),
    ("collision_rate", "collision rate"),
    ("capture_step", "capture step"),
    ("prediction_error", "prediction error [m]"),
    ("archive_size", "tasks in the archive"),
)


def plot_trajectories(path: Path, trajectories: Sequence[Trajectory]) -> None:
    """One panel per episode from above: paths, starts (hollow), pillars and the first
    capture (star).
    """
    columns = min(3, len(trajectories))
    rows = -(-len(trajectories) // columns)
    figure = Figure(figsize=(4 * columns, 4.3 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, trajectory in zip(panels, trajectories, strict=False):
        draw_from_above(axes, trajectory)
    for axes in panels[len(trajectories) :]:
        axes.set_axis_off()
    # one legend for all panels, each label once
    legend = {}
    for axes in figure.axes:
        artists, labels = axes.get_legend_handles_labels()
        for artist, label in zip(artists, labels, strict=True):
            legend.setdefault(label, artist)
    figure.legend(
        legend.values(), legend, loc="outside lower center", ncols=len(legend), fontsize="small"
    )
    _save(figure, path)


def draw_from_above(axes: Axes, trajectory: Trajectory) -> None:
    """One episode up to a second after its first capture, or whole without one."""
    axes.add_patch(Circle((0, 0), trajectory.arena_radius, fill=False, color="black"))
    for pillar in trajectory.pillar_position:
        axes.add_patch(Circle(pillar, trajectory.pillar_radius, color="0.6"))
    limit = 1.08 * trajectory.arena_radius
    axes.set(
        xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="x [m]", ylabel="y [m]"
    )
    _draw_pursuers(axes, trajectory)
    outcome = _draw_evader(axes, trajectory)
    axes.set_title(f"{trajectory.title}: {outcome}", fontsize="medium")


def _draw_pursuers(axes, trajectory):
    """Paths from an open to a full circle, and where one crashed."""
    end = trajectory.end()
    for i in range(trajectory.pursuer_position.shape[1]):
        x, y = trajectory.pursuer_position[:end, i, :2].T
        color = PURSUER_COLORS[i % len(PURSUER_COLORS)]
        axes.plot(x, y, color=color, linewidth=1.2, label=f"pursuer {i + 1}")
        axes.plot(x[0], y[0], "o", color=color, fillstyle="none")
        axes.plot(x[-1], y[-1], "o", color=color, markersize=4)
        crash = trajectory.crash_of(i)
        if crash is not None and crash < end:
            axes.plot(x[crash], y[crash], "X", color="black", markersize=9, label="crash")


def _draw_evader(axes, trajectory):
    """Its path, and where it was first captured; what became of it in words."""
    x, y = trajectory.evader_position[: trajectory.end(), :2].T
    axes.plot(x, y, color=EVADER_COLOR, linewidth=1.2, label="evader")
    axes.plot(x[0], y[0], "o", color=EVADER_COLOR, fillstyle="none")
    capture = trajectory.capture_index
    if capture is None:
        axes.plot(x[-1], y[-1], "o", color=EVADER_COLOR, markersize=4)
        return "not captured"
    x, y = trajectory.evader_position[capture, :2]
    radius = trajectory.capture_radius
    axes.add_patch(Circle((x, y), radius, fill=False, color="0.5", linestyle=":"))
    axes.plot(
        x, y, "*", color="gold", markeredgecolor="black", markersize=14, label="first capture"
    )
    return f"captured after {(capture + 1) * trajectory.time_step:.2f} s"


BOUNDS = {
    "forced_below": ("-", "below: points always catch (proved)"),
    "planar_below": ("--", "below: points always catch (solved, not proved)"),
}
"""Lines of a map by the names in its cells: how they are drawn and what they say."""


def plot_map(path: Path, cells: Sequence[dict], title: str) -> None:
    """A small map for each size of team: captures over capture radius and speed ratio,
    the line below which a theorem forces one, and, dashed, the one below which points
    can force one that fly one above another.

    cells: records of `openjax.commands.catch_map.cell_record`.
    """
    sizes = sorted({cell["num_pursuers"] for cell in cells})
    columns = min(4, len(sizes))
    rows = -(-len(sizes) // columns)
    figure = Figure(figsize=(3.1 * columns + 1.2, 3.0 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, size in zip(panels, sizes, strict=False):
        image = _draw_map(axes, [cell for cell in cells if cell["num_pursuers"] == size])
        axes.set_title(f"{size} pursuer{'s' if size > 1 else ''}", fontsize="medium")
    for axes in panels[len(sizes) :]:
        axes.set_axis_off()
    # of the panels, as a legend outside covers what a whole figure's axes are called
    for axes in panels[max(0, len(sizes) - columns) : len(sizes)]:
        axes.set_xlabel("capture radius [m]", fontsize="small")
    for axes in panels[::columns]:
        axes.set_ylabel("evader's speed / pursuers'", fontsize="small")
    figure.suptitle(title, fontsize="medium")
    lines = [
        Line2D([], [], color="red", linestyle=style, label=words)
        for style, words in BOUNDS.values()
    ]
    place = {"loc": "outside lower center", "ncols": min(2, columns)}
    figure.legend(handles=lines, fontsize="small", frameon=False, **place)
    figure.colorbar(image, ax=panels.tolist(), label="captured", shrink=0.8)
    _save(figure, path)


def _draw_map(axes, cells):
    """A team's map; returns the picture, for a colour bar."""
    viridis = colormaps["viridis"]
    radii = sorted({cell["capture_radius"] for cell in cells})
    ratios = sorted({cell["speed_ratio"] for cell in cells})
    rates = np.full((len(ratios), len(radii)), np.nan)
    bounds = {name: dict.fromkeys(radii, 0.0) for name in BOUNDS}
    for cell in cells:
        row = ratios.index(cell["speed_ratio"])
        column = radii.index(cell["capture_radius"])
        rates[row, column] = cell["capture_rate"]
        for name, bound_of in bounds.items():
            bound_of[cell["capture_radius"]] = cell.get(name, 0.0)
        text = f"{cell['capture_rate']:.2f}".replace("0.", ".")
        # the colour map is dark below its middle
        color = "white" if cell["capture_rate"] < 0.5 else "black"
        # a line that passes is interrupted
        halo = withStroke(linewidth=2, foreground=viridis(cell["capture_rate"]))
        style = {"fontsize": 6, "color": color, "path_effects": [halo]}
        axes.text(column, row, text, ha="center", va="center", **style)
    image = axes.imshow(rates, origin="lower", vmin=0, vmax=1, cmap=viridis, aspect="auto")
    axes.set_xticks(range(len(radii)), [f"{radius:g}" for radius in radii], fontsize=7)
    axes.set_yticks(range(len(ratios)), [f"{ratio:g}" for ratio in ratios], fontsize=7)
    # a picture's axes count cells: a ratio between two of them lies between their
    # middles
    ends = {"left": -0.5, "right": len(ratios) - 0.5}
    edges = np.arange(len(radii) + 1) - 0.5
    for name, bound_of in bounds.items():
        height = np.interp(list(bound_of.values()), ratios, range(len(ratios)), **ends)
        style = {"color": "red", "linewidth": 1.5, "linestyle": BOUNDS[name][0]}
        axes.stairs(height, edges, baseline=None, **style)
    return image


def plot_training(path: Path, metrics_path: Path) -> None:
    """Training curves and the validation results of a metrics file, over environment
    steps.
    """
    training = list(read_metrics(metrics_path, "train"))
    evaluation = list(read_metrics(metrics_path, "validation"))
    figure = Figure(figsize=(11, 6), layout="constrained")
    curves = (
        (training, {"color": "tab:blue", "linewidth": 1}, "training"),
        (evaluation, {"color": "tab:orange", "marker": "o", "markersize": 3}, "validation tasks"),
    )
    for axes, (name, label) in zip(figure.subplots(2, 3).ravel(), _CURVES, strict=True):
        for records, style, legend in curves:
            points = [
                (record["steps"], record[name])
                for record in records
                if record.get(name) is not None
            ]
            if points:
                steps, values = np.asarray(points, dtype=float).T
                axes.plot(steps, values, label=legend, **style)
        axes.set(xlabel="environment steps", ylabel=label)
        if axes.lines:
            axes.legend(fontsize="x-small")
    _save(figure, path)


def _save(figure, path):
    with replacing(path) as partial:
        figure.savefig(partial, dpi=120)
