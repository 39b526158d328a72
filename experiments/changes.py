"""What changed, on real flights with known changes: CrazyPAD (github.com/AerialRoboticsUUST/CrazyPAD, commit 5448265, MIT;
Masalimov et al., Data 2024, 9(6), 79), micro-SD logs of two Crazyflies without orientation.

    python -m experiments.changes open FOLDER      # conditions in folders, labels.json: table with the truth beside
    python -m experiments.changes answer FOLDER    # reference/ and case_*/: answers alone, as JSON
    python -m experiments.changes figure FOLDER    # flies three days into an empty folder: the figure of docs/what_changed.md

`open` compares every condition with all normal flights, and each day of normal flights with the other days; the table
goes to experiments/results/changes_e8.md. `answer` writes changes_e9.json. Nothing is fitted to
either: what the comparison assumes stands at the top of the modules of `openjax.comparison`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from openjax import comparison
from openjax.comparison.report import draw, in_words, prediction
from openjax.flights.reading import write_csv
from openjax.flights.samples import fly, log_of, references
from openjax.vehicle import load_vehicle

RESULTS = Path(__file__).parent / "results"


def commit() -> str:
    """The commit that is checked out."""
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()


def answer(folder: Path) -> dict:
    """{case: prediction} of every case_* against reference/."""
    out = {}
    for case in sorted(folder.glob("case_*")):
        change = comparison.compare(case, [folder / "reference"])
        out[case.name] = prediction(change) | {"least_shown": round(change.least, 4)}
        print(case.name, out[case.name], flush=True)
    return out


def open_table(folder: Path) -> str:
    """The table of an open vehicle, as Markdown."""
    labels = json.loads((folder / "labels.json").read_text())
    read = {name: comparison.read(folder / name) for name in labels}
    (normal,) = [name for name, label in labels.items() if label["cause"] == "none"]
    case, reference, _ = read[normal]
    rows, cuts = [], []

    def compare(name, truth, new, old):
        change = comparison.change_between(name, new, old, case)
        answer = prediction(change)
        rotors = "+".join(f"m{r}" for r in answer["rotors"]) or "–"
        low, high = change.size.low, change.size.high
        rows.append((
            name, truth, len(new), f"{change.probability:.2f}", "yes" if change.changed else "no", rotors,
            ", ".join(change.likely_causes) if change.changed else "–",
            f"{100 * change.size.value:.0f} [{100 * low:.0f}, {100 * high:.0f}]", f"{100 * change.least:.0f}",
        ))  # fmt: skip
        return change

    days = list(dict.fromkeys(f.day for f in reference))
    quiet = [
        compare(f"normal flights, day {k + 1}", "none", [f for f in reference if f.day == day],
                [f for f in reference if f.day != day])
        for k, day in enumerate(days)
    ]  # fmt: skip
    single = [
        comparison.change_between(
            "one", [dataclasses.replace(f, day="one")], [g for g in reference if g.day != f.day], case
        )
        for f in reference
    ]
    named = {True: [], False: []}
    for name, label in labels.items():
        if name == normal:
            continue
        millimetres = sum(label.get("mm", {}).values())
        truth = label["cause"] + (f", {millimetres:g} mm" if millimetres else "")
        truth += " " + "+".join(f"m{r}" for r in label["rotors"])
        change = compare(name, truth, read[name][1], reference)
        if label["cause"] == "tape":
            quiet.append(change)
        if label["cause"] == "cut":
            cuts.append((millimetres, change.size.value))
            if change.changed:
                named[set(label["rotors"]) <= set(change.rotors)].append(name)
    large = [name for name, label in labels.items() if sum(label.get("mm", {}).values()) >= 4]
    found = [r for r in rows if r[0] in large and r[4] == "yes"]
    header = ("condition", "truth", "flights", "P(changed)", "changed", "rotors", "cause",
              "thrust lost, % of a rotor's [90 %]", "least that shows, %")  # fmt: skip
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    silent = sum(not c.changed for c in quiet)
    alone = sum(not c.changed for c in single)
    figures = [
        f"* normal flights of another day and tape: no change in {silent} of {len(quiet)}; "
        f"each normal flight alone against the other days: {alone} of {len(single)}",
        f"* a rotor cut by 4 mm or more: changed in {len(found)} of {len(large)}",
        f"* cuts that were found: the rotor right in {len(named[True])} of {len(named[True]) + len(named[False])}",
        f"* size against millimetres: Spearman {spearmanr(*zip(*cuts, strict=True)).statistic:.2f} over {len(cuts)} cuts",
    ]
    return "\n".join([*lines, "", *figures])


def figure(folder: Path) -> list[str]:
    """Two normal days, whose rotors differ by 2 % as new propellers do, and one with rotor 3 weaker by 22 %."""
    vehicle, rng = load_vehicle(), np.random.default_rng(3)
    for seed, (name, weaker) in enumerate({"friday": 0.0, "monday": 0.0, "tuesday": 0.22}.items(), 1):
        (folder / name).mkdir(parents=True)
        factors = 0.02 * rng.standard_normal(4) - weaker * np.array([0.0, 0.0, 1.0, 0.0])
        effects = {"motor_imbalance": {f"m{i}": float(f) for i, f in enumerate(factors, 1)}}
        for k, (flight, reference) in enumerate(references(seed=seed, duration=8.0).items()):
            columns = fly(vehicle, vehicle, reference, 10 * seed + k, effects)
            write_csv(folder / name / f"{flight}.csv.gz", log_of(columns, flight))
    change = comparison.compare(folder / "tuesday", [folder / "friday", folder / "monday"])
    draw(change).savefig(Path(__file__).parents[1] / "docs" / "what_changed.png", dpi=90)
    return in_words(change)


def main() -> None:
    """Run one of the three."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("open", "answer", "figure"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the page or the answers")
    parser.add_argument("--commit", help="said on the page where git isn't there")
    options = parser.parse_args()
    if options.what == "figure":
        print("\n".join(figure(options.folder)))
        return
    made_at = options.commit or commit()
    if options.what == "open":
        text = (
            "# What changed: real flights of one Crazyflie with known changes (CrazyPAD, vehicle E8)\n\n"
            f"`python -m experiments.changes open FOLDER` at {made_at}; {os.cpu_count()} cores. Every condition against all\n"
            "normal flights (twelve logs, three days by their trims), every day of normal flights against the others. Logs of\n"
            "the motors and of the controller together; no orientation, in motor logs no gyroscope.\n\n"
        )
        (options.out / "changes_e8.md").write_text(text + open_table(options.folder) + "\n", encoding="utf-8")
    else:
        found = {
            "commit": made_at,
            "command": "python -m experiments.changes answer FOLDER",
            "cases": answer(options.folder),
        }
        (options.out / "changes_e9.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
