"""Page and picture of experiments/sweeps.py."""

from pathlib import Path

import numpy as np
from pages import table
from run_comparison import VARIANTS, variant_of

FOUR = ("wall", "narrow_gap", "random", "passage")
"""The paper's layouts with pillars."""


def by_variant(results: dict) -> dict[str, dict[str, np.ndarray]]:
    """Figures with leading axis seeds by variant, in the paper's order."""
    groups: dict[str, list] = {name: [] for name in VARIANTS}
    for policy in results["policies"]:
        groups[variant_of(policy["settings"])].append(policy)
    fields = ("capture_rate", "capture_step", "collision_rate", "crash_rate")
    return {
        name: {field: np.array([policy[field] for policy in group]) for field in fields}
        for name, group in groups.items()
        if group
    }


def own_values(results: dict) -> tuple[float, float]:
    """Evader speed and capture radius that the policies were trained at."""
    game = results["policies"][0]["settings"]["environment"]
    return game["evader_speed"], game["capture_radius"]


def report(results: dict) -> list[str]:
    """The page."""
    variants = by_variant(results)
    machine = results["machine"]
    commit = results["commit"] or machine.get("commit") or "unknown"
    own_speed, own_radius = own_values(results)
    at_speed, at_radius = results["speeds"].index(own_speed), results["radii"].index(own_radius)
    steps = {
        variant_of(policy["settings"]): policy["settings"]["total_steps"] / 1e6
        for policy in results["policies"]
    }
    seeds = ", ".join(
        f"{name} {len(figures['capture_rate'])} (trained for {steps[name]:.0f} M steps)"
        for name, figures in variants.items()
    )
    limit = "speed clamp" if results["speed_limit"] == "clamp" else "no speed clamp"
    lines = [
        "# Capture radius and evader speed",
        "",
        f"`{results['command']}` on {machine['device']}, JAX {machine['versions']['jax']}, commit {commit}: "
        f"{results['seconds']:.0f} s. {results['note']}".rstrip(),
        "",
        f"Policies trained at a radius of {own_radius} m and an evader of {own_speed} m/s, at others without training anew; "
        f"{limit}, drawn starts, {results['episodes']} episodes per seed and cell. Seeds: {seeds}. Capture rate / "
        "capture step, mean over seeds. The paper shows its radii in `empty` and its speeds in `passage`, as figures "
        "without numbers.",
    ]
    for title, unit, values, part in (
        (f"Capture radius, evader at {own_speed} m/s", "m", results["radii"], np.s_[:, :, at_speed]),
        (f"Evader speed, radius {own_radius} m", "m/s", results["speeds"], np.s_[..., at_radius]),
    ):
        rows = []
        for at, layout in enumerate(results["layouts"]):
            for name, figures in variants.items():
                rates, steps = (
                    figures[field][part][:, at].mean(axis=0) for field in ("capture_rate", "capture_step")
                )
                cells = [f"{rate:.2f} / {step:.0f}" for rate, step in zip(rates, steps, strict=True)]
                rows.append([layout, name, *cells])
        lines += ["", f"## {title}", ""]
        lines += table(["layout", "variant", *(f"{value} {unit}" for value in values)], rows)
    rows = [
        [layout, name]
        + [
            f"{figures['collision_rate'][:, at, i].mean():.4f} / {figures['crash_rate'][:, at, i].mean():.2f}"
            for i in range(len(results["speeds"]))
        ]
        for at, layout in enumerate(results["layouts"])
        for name, figures in variants.items()
    ]
    lines += ["", "## Collision rate / crash rate by evader speed", ""]
    lines += table(["layout", "variant", *(f"{value} m/s" for value in results["speeds"])], rows)
    return lines


def draw(results: dict, path: Path) -> None:
    """Capture rate and step over radius in `empty`, over speed in `passage`, and both as means of the four layouts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    own_speed, own_radius = own_values(results)
    at_speed, at_radius = results["speeds"].index(own_speed), results["radii"].index(own_radius)
    figure = Figure(figsize=(15, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 4, sharex="col", sharey="row")
    columns = (
        ("capture radius (m)", "empty", ("empty",)),
        ("capture radius (m)", "mean of the paper's four", FOUR),
        ("evader speed (m/s)", "passage", ("passage",)),
        ("evader speed (m/s)", "mean of the paper's four", FOUR),
    )
    colors = dict(zip(VARIANTS, ("tab:red", "tab:blue", "tab:green", "0.3", "tab:olive"), strict=True))
    for j, (label, title, names) in enumerate(columns):
        at = [results["layouts"].index(name) for name in names]
        over_radius = "radius" in label
        x, own = (results["radii"], own_radius) if over_radius else (results["speeds"], own_speed)
        for row, field in enumerate(("capture_rate", "capture_step")):
            axis = axes[row, j]
            for name, figures in by_variant(results).items():
                values = figures[field][:, at].mean(axis=1)
                values = values[:, at_speed] if over_radius else values[:, :, at_radius]
                axis.plot(x, values.mean(axis=0), color=colors[name], marker="o", markersize=3, label=name)
                axis.fill_between(
                    x, values.min(axis=0), values.max(axis=0), color=colors[name], alpha=0.15, linewidth=0
                )
            axis.axvline(own, color="black", linewidth=0.8, linestyle=":")
            axis.grid(alpha=0.3)
        axes[0, j].set_title(title, fontsize="medium")
        axes[1, j].set_xlabel(label)
    axes[0, 0].set_ylabel("capture rate")
    axes[1, 0].set_ylabel("capture step")
    axes[0, 0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
