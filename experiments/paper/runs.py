"""Comparing training runs: what they are, how much data they needed, which part of a two by two design matters."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from experiments.paper.headline import fly
from openjax.errors import UserError
from openjax.files import read_json
from openjax.pursuit import SCENARIOS
from openjax.show.metrics import METRICS_FILE, read_metrics
from openjax.store.run_directory import RunDirectory, open_run

VARIANTS = ("OPEN", "MAPPO + predictor", "MAPPO + generator", "MAPPO", "MAPPO, one-sided tasks")
"""In the order of the paper; the last draws the paper's uniform tasks, which all have the evader on one side."""
SWITCHES = {"seed": (), "enabled": ("predictor", "generator"), "turn": ("generator",)}
"""Settings in which runs may differ, and the groups they belong to."""
CURVES = ("capture_rate", "capture_step", "collision_rate", "crash_rate")
"""What is kept of the validation results."""


def variant_of(settings: dict) -> str:
    """Which of `VARIANTS` plain settings make, or DACOOP."""
    if settings["network"].get("output") == "field":
        return "DACOOP"
    predictor, generator = settings["predictor"]["enabled"], settings["generator"]["enabled"]
    if not settings["generator"]["turn"]:
        if predictor or generator:
            raise UserError("one-sided tasks (--generator.turn False) are for plain MAPPO only")
        return VARIANTS[4]
    return VARIANTS[(0 if predictor else 2) if generator else (1 if predictor else 3)]


def common_settings(settings: dict, group: str = "") -> dict:
    """What must be the same in all runs, flat: everything but seed and switches."""
    flat = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            flat |= common_settings(value, name)
        elif not (name in SWITCHES and (group in SWITCHES[name] or not SWITCHES[name])):
            flat[f"{group}.{name}" if group else name] = value
    return flat


def read_run(path: Path, episodes: int) -> dict:
    """One run as plain values: variant, seed, validation curve and layouts.

    Raises:
      UserError: no run, no evaluations, or steps that aren't those of all its worlds.
    """
    run = open_run(path)
    stored = read_json(run.settings_file)
    settings = stored["settings"]
    per_update = settings["num_envs"] * settings["rollout_length"]
    curve = []
    for record in read_metrics(run.path / METRICS_FILE, "validation"):
        if record["steps"] != record["update"] * per_update:
            raise UserError(
                f"{path}: {record['steps']} steps after {record['update']} updates of {per_update}"
            )
        # other validation sets, where a run has them, carry a prefix
        kept = {name: value for name, value in record.items() if name.endswith(CURVES)}
        curve.append({name: record[name] for name in ("steps", "seconds")} | kept)
    if not curve:
        raise UserError(f"{path}: no evaluation in {METRICS_FILE}")
    return {
        "variant": variant_of(settings),
        "seed": settings["seed"],
        "command": stored.get("command"),
        "machine": stored.get("machine"),
        "steps": curve[-1]["steps"],
        "settings": common_settings(settings),
        "validation": curve,
        "layouts": layouts_of(run, episodes),
    }


def layouts_of(run: RunDirectory, episodes: int) -> list[dict]:
    """Records of the run's best policy on the six layouts: those that it wrote itself, or flown here."""
    file = run.path / "layouts.json"
    if file.exists():
        rows = {row["scenario"]: row for row in read_json(file)["after"]}
        rows = [rows[name] for name in SCENARIOS if name in rows]
        if len(rows) == len(SCENARIOS) and all(
            row["episodes"] == episodes and "last_seen_error" in row for row in rows
        ):
            return rows
    return fly(run.policy, {}, episodes)


def steps_to(curve: list[dict], rate: float, field: str = "capture_rate") -> int | None:
    """Environment steps of the first evaluation that reaches `rate`; None if none does."""
    return next((record["steps"] for record in curve if record[field] >= rate), None)


def band(runs: list[dict], field: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps (T,) and values (seeds, T) of a variant's validation curves, as far as all of them go.

    Runs with other intervals between evaluations are interpolated on the first one's.
    """
    end = min(run["validation"][-1]["steps"] for run in runs)
    grid = np.array([r["steps"] for r in runs[0]["validation"] if r["steps"] <= end], float)
    values = [
        np.interp(grid, [r["steps"] for r in run["validation"]], [r[field] for r in run["validation"]])
        for run in runs
    ]
    return grid, np.array(values)


def draw_band(axis: Any, runs: dict[str, list[dict]], field: str, colors: dict[str, str]) -> None:
    """Mean and range over seeds of every variant's validation curve."""
    for name, group in runs.items():
        steps, values = band(group, field)
        axis.plot(steps / 1e6, values.mean(axis=0), color=colors[name], label=name)
        low, high = values.min(axis=0), values.max(axis=0)
        axis.fill_between(steps / 1e6, low, high, color=colors[name], alpha=0.15, linewidth=0)
    axis.set(xlabel="environment steps (million)", ylabel=field.replace("_", " "))
    axis.grid(alpha=0.3)


def savings(runs: dict[str, list[dict]], field: str, rate: float) -> list[tuple[str, list, str]]:
    """Per variant the steps to `rate` of each seed and their ratio to plain MAPPO's, as a text.

    The ratio is that of the means over seeds, with the smallest and largest of all pairs of seeds. A seed that never
    reaches it counts with all its steps, which makes the ratio a bound.
    """
    reached = {
        name: [steps_to(run["validation"], rate, field) for run in group] for name, group in runs.items()
    }
    rows = []
    for name, steps in reached.items():
        text = "–"
        base = reached.get("MAPPO")
        if base and name != "MAPPO":
            own = [s or run["steps"] for s, run in zip(steps, runs[name], strict=True)]
            other = [s or run["steps"] for s, run in zip(base, runs["MAPPO"], strict=True)]
            pairs = [a / b for a, b in itertools.product(own, other)]
            sign = ("≥ " if None in steps else "") + ("≤ " if None in base else "")
            sign = "" if sign.count(" ") > 1 else sign
            text = f"{sign}{np.mean(own) / np.mean(other):.2f} ({min(pairs):.2f} to {max(pairs):.2f})"
            text += " (neither always reached it)" if None in steps and None in base else ""
        rows.append((name, steps, text))
    return rows


def main_effects(
    runs: dict[str, list[dict]], value: Callable[[dict], float | None]
) -> dict[str, tuple[float, float]] | None:
    """What generator, predictor and both together change in `value(run)`: (difference, half of 95 % interval).

    The four variants are a two by two design: a main effect is the mean over both settings of the other part, the
    interaction half the difference of the two. None without two seeds of each or where a value is missing.
    """
    cells = [[value(run) for run in runs.get(name, [])] for name in VARIANTS[:4]]
    count = min(len(cell) for cell in cells)
    if count < 2 or any(x is None for cell in cells for x in cell):
        return None
    both, predictor, generator, neither = (float(np.mean(cell)) for cell in cells)
    freedom = sum(len(cell) - 1 for cell in cells)
    variance = sum(float(np.var(cell, ddof=1)) * (len(cell) - 1) for cell in cells) / freedom
    # each effect is half the sum of four cell means with signs
    half = 0.5 * np.sqrt(variance * sum(1 / len(cell) for cell in cells))
    half *= float(student.ppf(0.975, freedom))
    return {
        "generator": (0.5 * (both - predictor + generator - neither), half),
        "predictor": (0.5 * (both - generator + predictor - neither), half),
        "interaction": (0.5 * (both - generator - predictor + neither), half),
    }


def by_variant(records: list[dict]) -> dict[str, list[dict]]:
    """Runs by variant, in the paper's order, then by seed.

    Raises:
      UserError: runs that differ in more than seed and switches, or one given twice.
    """
    first = records[0]
    for run in records[1:]:
        names = set(first["settings"]) | set(run["settings"])
        other = sorted(n for n in names if first["settings"].get(n) != run["settings"].get(n))
        if other:
            raise UserError(
                f"runs {first['variant']} seed {first['seed']} and {run['variant']} seed {run['seed']} "
                f"differ in {', '.join(other)}: no fair comparison"
            )
    runs = {name: [run for run in records if run["variant"] == name] for name in VARIANTS}
    runs = {name: sorted(group, key=lambda run: run["seed"]) for name, group in runs.items() if group}
    for name, group in runs.items():
        if len({run["seed"] for run in group}) < len(group):
            raise UserError(f"{name}: a seed was given twice")
    return runs
