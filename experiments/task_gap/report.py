"""From episodes to the table: how large the gap in each figure is without and with the diagnosed effects."""

import json
from pathlib import Path

import numpy as np

from experiments.pages import table
from experiments.task_gap.jobs import world_folder, world_name
from openjax.commands.machine import describe_machine
from openjax.store.settings_files import write_json

FIGURES = {
    "captured": ("capture rate", ".3f"),
    "capture_step": ("capture step", ".0f"),
    "captured_closely": ("capture rate within half the radius", ".3f"),
    "collision_rate": ("collision rate", ".4f"),
    "crashed": ("crash rate", ".3f"),
}
DRAWS = 2000


def load_world(work: Path, policy: str, condition: str, name: str) -> dict[str, np.ndarray] | None:
    """Figures of all episodes of a world by their number, or None if there are none."""
    place = world_folder(work, policy, condition)
    chunks = {}
    for path in place.glob(f"{name}_*_*.json"):
        stem = path.stem.removeprefix(f"{name}_").split("_")
        if len(stem) == 2 and all(part.isdigit() for part in stem):
            chunks[int(stem[0])] = json.loads(path.read_text())
    if not chunks:
        return None
    index = np.concatenate([start + np.arange(len(c["captured"])) for start, c in sorted(chunks.items())])
    values = {f: np.concatenate([c[f] for _, c in sorted(chunks.items())]) for f in chunks[min(chunks)]}
    return {"episode": index} | values


def paired(worlds: dict[str, dict]) -> dict[str, dict]:
    """The worlds with the episodes that all of them have, in the same order."""
    common = set.intersection(*(set(w["episode"].tolist()) for w in worlds.values()))
    keep = np.array(sorted(common), int)
    out = {}
    for name, world in worlds.items():
        place = {e: i for i, e in enumerate(world["episode"].tolist())}
        rows = [place[e] for e in keep.tolist()]
        out[name] = {f: v[rows] for f, v in world.items()}
    return out


def difference(a: np.ndarray, b: np.ndarray) -> dict:
    """Mean of a - b over paired episodes, its standard error, and a 95 % interval."""
    d = np.asarray(a, float) - np.asarray(b, float)
    error = float(d.std(ddof=1) / np.sqrt(len(d))) if len(d) > 1 else float("nan")
    mean = float(d.mean())
    return {"mean": mean, "error": error, "interval95": [mean - 1.96 * error, mean + 1.96 * error]}


def compare(worlds: dict[str, dict]) -> dict:
    """The figures of one case in its three worlds, and the gaps between them."""
    worlds = paired(worlds)
    out = {"episodes": len(worlds["plant"]["captured"])}
    for figure in FIGURES:
        values = {name: world[figure] for name, world in worlds.items()}
        out[figure] = {
            **{name: float(v.mean()) for name, v in values.items()},
            "before": difference(values["plant"], values["nominal"]),
            "after": difference(values["plant"], values["corrected"]),
        }
    return out


def size_of_gaps(means, errors) -> float:
    """Root mean square of gaps of which chance made a part: mean squares less the squared standard errors."""
    means, errors = np.asarray(means), np.asarray(errors)
    return float(np.sqrt(max(np.mean(means**2 - errors**2), 0.0)))


def pool(rows: list[dict], figure: str, rng) -> dict:
    """Gaps over cases: root mean squares before and after, and the share closed with a bootstrap over cases."""
    parts = {
        side: (
            np.array([r[figure][side]["mean"] for r in rows]),
            np.array([r[figure][side]["error"] for r in rows]),
        )
        for side in ("before", "after")
    }
    size = {side: size_of_gaps(*values) for side, values in parts.items()}
    plain = {f"mean_absolute_{side}": float(np.abs(m).mean()) for side, (m, _) in parts.items()}
    shares = []
    for _ in range(DRAWS):
        drawn = rng.integers(0, len(rows), len(rows))
        before, after = (size_of_gaps(m[drawn], e[drawn]) for m, e in parts.values())
        if before > 0:
            shares.append(1 - after / before)
    share = 1 - size["after"] / size["before"] if size["before"] > 0 else None
    interval = np.percentile(shares, [2.5, 97.5]).tolist() if len(shares) > 0.9 * DRAWS else None
    clear = [abs(m) > 1.96 * e for m, e in zip(*parts["before"], strict=True)]
    still = [abs(m) > 1.96 * e for m, e in zip(*parts["after"], strict=True)]
    return {
        **size,
        **plain,
        "closed": share,
        "interval95": interval,
        "cases": len(rows),
        "clear_before": int(sum(clear)),
        "clear_after": int(sum(still)),
    }


def results(cases, options) -> dict:
    """Everything measured, as plain values."""
    rng = np.random.default_rng(0)
    found = {c.name: json.loads((options.work / "flights" / f"{c.name}.json").read_text()) for c in cases}
    out = {"cases": {}, "conditions": {}}
    for case in cases:
        told = found[case.name]
        out["cases"][case.name] = {"effect": case.effect, **told["flown"], "diagnosis": told["found"]}
    for condition in options.conditions:
        for substeps in options.substeps:
            rows = compare_cases(cases, found, options, condition, substeps)
            caused = [row for case in cases if case.cause and (row := rows.get(case.name))]
            calm = [row for case in cases if not case.cause and (row := rows.get(case.name))]
            summary = {"caused": {f: pool(caused, f, rng) for f in FIGURES}} if caused else {}
            if calm:
                summary["none"] = {f: size_of_gaps(*_column(calm, f)) for f in FIGURES}
            title = f"{condition}; simulators' rate loop at {100 * substeps} Hz"
            out["conditions"][title] = {"cases": rows, "summary": summary}
    return out


def compare_cases(cases, found, options, condition, substeps) -> dict:
    """`compare` of each case whose worlds have been flown."""

    def load(world, case):
        return load_world(options.work, options.policy, condition, world_name(world, case, substeps))

    nominal, rows = load("nominal", None), {}
    for case in cases:
        plant, corrected = load("plant", case), nominal
        if found[case.name]["found"]["parameters"]:
            corrected = load("corrected", case)
        if nominal is not None and plant is not None and corrected is not None:
            rows[case.name] = compare({"nominal": nominal, "plant": plant, "corrected": corrected})
    return rows


def _column(rows, figure):
    return [r[figure]["before"]["mean"] for r in rows], [r[figure]["before"]["error"] for r in rows]


def write_results(cases, options) -> None:
    """RESULTS.json and RESULTS.md."""
    measured = results(cases, options)
    told = {
        k: str(v) if isinstance(v, Path) else v
        for k, v in vars(options).items()
        if k not in ("work", "results")
    }
    machine = describe_machine()
    if options.commit:  # the tree travelled without its repository
        machine["commit"] = options.commit
    write_json(Path(f"{options.results}.json"), {"settings": told, "machine": machine, **measured})
    Path(f"{options.results}.md").write_text(markdown(cases, options, measured, machine), encoding="utf-8")


def markdown(cases, options, measured, machine) -> str:
    """The tables."""
    lines = [
        "# The gap in the task: nominal simulator, flights' world, corrected simulator",
        "",
        f"`python -m experiments.task_gap --policy {options.policy} --seed {options.seed} --episodes {options.episodes} "
        f"--substeps {' '.join(map(str, options.substeps))} --conditions {' '.join(map(repr, options.conditions))}` on "
        f"{machine['device']}, JAX {machine['versions']['jax']}, commit {machine['commit']}.",
        "",
        METHOD,
    ]
    for condition, values in measured["conditions"].items():
        summary = values["summary"]
        if not summary:
            continue
        lines += ["", f"## {condition}", ""]
        lines += [*_summary_table(summary), "", *_case_table(cases, measured["cases"], values["cases"])]
    return "\n".join(lines) + "\n"


METHOD = """Flights of the exam's plant (`experiments/diagnosis`, no code shared with openjax) with one cause each, at
three quarters of its usual range, are diagnosed; then the policy plays the same uniform tasks from the same starts in three
worlds: *nominal* (the simulator), *flights* (that plant with that cause, its gusts and sensor noise, at 1 kHz; only the game
around it is openjax's), *corrected* (the simulator with the diagnosed effects.toml). Differences are paired by episode; ± is
1.96 standard errors. The size of the gap over cases is the root mean square of the differences, less what chance makes of
it; the share closed has a 95 % interval from a bootstrap over cases; "clear" counts the cases whose interval excludes no gap.
The simulator steps its rate loop at 100 Hz like the policy by default; at 500 Hz (`substeps = 5`) it runs as on board.
"none" is the plant without a cause: what remains there is the plant's own ways (gusts, noise), which no effect is to close."""


def _summary_table(summary):
    heads = ["figure", "gap before", "gap after", "closed", "95 %", "mean absolute, before → after", "cases"]
    heads += ["clear before, after", "gap of none"]
    rows = []
    for figure, (title, style) in FIGURES.items():
        s = summary.get("caused", {}).get(figure)
        if s is None:
            continue
        style = ".1f" if figure == "capture_step" else ".4f"
        rows.append(
            [
                title,
                f"{s['before']:{style}}",
                f"{s['after']:{style}}",
                "–" if s["closed"] is None else f"{s['closed']:.2f}",
                "–" if s["interval95"] is None else "{:.2f} to {:.2f}".format(*s["interval95"]),
                f"{s['mean_absolute_before']:{style}} → {s['mean_absolute_after']:{style}}",
                str(s["cases"]),
                f"{s['clear_before']}, {s['clear_after']}",
                f"{summary['none'][figure]:{style}}" if "none" in summary else "–",
            ]
        )
    return table(heads, rows)


def _case_table(cases, told, rows):
    shown = []
    for case in cases:
        row = rows.get(case.name)
        if row is None:
            continue
        said = told[case.name]
        cause = "none" if case.cause is None else f"{case.effect} ({said['form']}, {said['size']:.3g})"
        named = ", ".join(said["diagnosis"]["effects"]) or said["diagnosis"]["verdict"]
        cells = [cause, named, str(row["episodes"])]
        for figure, (_, style) in FIGURES.items():
            r = row[figure]
            gaps = [f"{r[s]['mean']:+{style}} ± {1.96 * r[s]['error']:{style}}" for s in ("before", "after")]
            cells.append(
                f"{r['nominal']:{style}}, {r['plant']:{style}}, {r['corrected']:{style}} ({gaps[0]} → {gaps[1]})"
            )
        shown.append(cells)
    heads = ["cause (form, size)", "diagnosed", "episodes", *(title for title, _ in FIGURES.values())]
    return [
        "Each cell: nominal, flights, corrected (gap to the flights before → after).",
        "",
        *table(heads, shown),
    ]
