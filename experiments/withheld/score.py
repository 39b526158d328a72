"""Open the answers and score the predictions against the figures to reach.

python -m experiments.withheld.score --answers A.json --predictions P.json --reports R.json --out
experiments/results/withheld
"""

import argparse
import hashlib
import json
import platform
import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np

from experiments.withheld import score_metrics as m
from experiments.withheld import score_parameters

# GAP.md, "Figures to reach": key -> (what, target, whether larger is better)
TARGETS = {
    "top1": ("single cause or none, all severities: top-1", 0.90, True),
    "top2": ("the same: top-2", 0.97, True),
    "worst_class": ("the same: worst class, top-1", 0.75, True),
    "top1_medium_high": ("medium and high severity: top-1", 0.97, True),
    "pair_f1": ("two causes: set F1", 0.85, True),
    "pair_exact": ("two causes: exact set", 0.70, True),
    "false_alarm": ("none: false alarms", 0.05, False),
    "false_unknown": ("named effect is the cause: false unknown", 0.05, False),
    "unknown_recall": ("unknown: recall", 0.80, True),
    "unknown_wrong_name": ("unknown: wrong name given", 0.10, False),
    "calibration_error": ("probabilities: expected calibration error", 0.05, False),
    "error_lag_drag_scale": ("parameters, lag, drag and scale: median relative error", 0.10, False),
    "error_ground_wake_battery": (
        "parameters, ground, downwash, battery: median relative error",
        0.20,
        False,
    ),
    "coverage90": ("parameters: coverage of 90 % intervals (85 to 95 %)", 0.85, True),
    "gap_closed": ("held-out gap closed, of what the true effect closes (median)", 0.80, True),
    "gap_negative": ("held-out gap made larger by more than 1 %", 0.0, False),
    "seconds": ("seconds a case, median", 5.0, False),
}
QUICK = ("motor_lag", "command_latency", "state_latency", "rotor_drag", "thrust_scale", "mass")
COARSE = ("ground_effect", "ceiling_effect", "downwash", "battery_sag")


def score(answers, predictions, reports):
    """All figures: {"figures": {...}, "per_class": ..., "per_severity": ..., "confusion": ..., "reliability":
    ...}.
    """
    missing = sorted(set(answers) - set(predictions))
    empty = {"effects": [], "probabilities": {"none": 1.0}, "where": "", "reduction": 0.0, "not_testable": []}
    cases = [(a, predictions.get(name, empty)) for name, a in sorted(answers.items())]
    single = [(a, p) for a, p in cases if a["kind"] == "single"]
    none = [(a, p) for a, p in cases if a["kind"] == "none"]
    pair = [(a, p) for a, p in cases if a["kind"] == "pair"]
    unknown = [(a, p) for a, p in cases if a["kind"] in ("unknown", "left_out")]
    blind = [(a, p) for a, p in cases if a["kind"] == "not_testable"]
    strong = [(a, p) for a, p in single if a["severity"] in ("medium", "high")]

    def right(a, p):
        return m.first(p, a) == m.true_class(a)

    per_class = {}
    for name in m.CLASSES[:-1]:
        own = none if name == "none" else [(a, p) for a, p in single if a["effects"][0] == name]
        if own:
            per_class[name] = {
                "top1": m.share(right(a, p) for a, p in own),
                "top2": m.share(m.in_first_two(p, a) for a, p in own),
            }
    figures = {
        "top1": m.share(right(a, p) for a, p in single + none),
        "top2": m.share(m.in_first_two(p, a) for a, p in single + none),
        "top1_single_only": m.share(right(a, p) for a, p in single),
        "top1_medium_high": m.share(right(a, p) for a, p in strong),
        "single_exact_set": m.share(m.set_f1(p, a) == 1.0 for a, p in single),
        "pair_f1": m.average([m.set_f1(p, a) for a, p in pair]),
        "pair_exact": m.share(m.set_f1(p, a) == 1.0 for a, p in pair),
        "false_alarm": m.share(len(p["effects"]) > 0 for _, p in none),
        "false_unknown": m.share("unknown" in p["effects"] for _, p in single),
        "unknown_recall": m.share("unknown" in p["effects"] for _, p in unknown),
        "unknown_recall_outside": m.share(
            "unknown" in p["effects"] for a, p in unknown if a["kind"] == "unknown"
        ),
        "unknown_recall_left_out": m.share(
            "unknown" in p["effects"] for a, p in unknown if a["kind"] == "left_out"
        ),
        "unknown_wrong_name": m.share(
            len(p["effects"]) > 0 and "unknown" not in p["effects"] for _, p in unknown
        ),
        "not_testable_silent": m.share(len(p["effects"]) == 0 for _, p in blind),
        "not_testable_says_so": m.share(a["hidden"] in (p.get("not_testable") or []) for a, p in blind),
        "calibration_error": m.calibration_interval(m.top_pairs(cases)),
    }
    worst = min(per_class, key=lambda k: per_class[k]["top1"]["value"], default=None)
    figures["worst_class"] = (per_class[worst]["top1"] | {"class": worst}) if worst else m.share([])
    table = m.not_testable_table(cases)
    figures["not_testable_precision"] = m.share(truth for listed, truth in table if listed)
    figures["not_testable_recall"] = m.share(listed for listed, truth in table if truth)
    figures |= _parameters(cases, reports) | _gap(single, reports)
    figures["seconds"] = m.average([p["seconds"] for _, p in cases if p.get("seconds")], np.median)
    severities = {
        s: m.share(right(a, p) for a, p in single if a["severity"] == s)
        for s in ("hidden", "low", "medium", "high")
    }
    return {
        "figures": figures,
        "per_class": per_class,
        "per_severity": severities,
        "confusion": confusion(cases),
        "reliability": m.calibration(m.top_pairs(cases))[1],
        "cases": {
            k: sum(a["kind"] == k for a, _ in cases)
            for k in ("none", "single", "pair", "unknown", "left_out", "not_testable")
        },
        "without_prediction": missing,
    }


def _parameters(cases, reports):
    rows = [
        r
        for a, _ in cases
        if a["kind"] in ("single", "pair")
        for r in score_parameters.compare(a, reports.get(a["case"], {}))
    ]
    out = {}
    for key, effects in (
        ("error_lag_drag_scale", QUICK),
        ("error_ground_wake_battery", COARSE),
        ("error_all", None),
    ):
        out[key] = m.average(
            [r["relative_error"] for r in rows if effects is None or r["effect"] in effects], np.median
        )
    for effect in sorted({r["effect"] for r in rows}):
        out["error_" + effect] = m.average(
            [r["relative_error"] for r in rows if r["effect"] == effect], np.median
        )
    out["coverage90"] = m.share(c for r in rows for c in r["covered"])
    return out


def _gap(single, reports):
    """Reduction of the held-out gap where the cause is real and shows (medium, high), beside what the truth
    closes.

    The share closed of what can be closed is (before - after) / (before - floor) in the report's own measure,
    where there is at least a twentieth of the floor to close; `gap_closed_by_truth` is what the true effect
    closes in the measure of `replay.py`, for comparison.
    """
    shares, reductions, truths = [], [], []
    for a, p in single:
        if a["severity"] not in ("medium", "high") or p.get("reduction") is None:
            continue
        gap = (reports.get(a["case"]) or {}).get("gap") or {}
        reductions.append(gap.get("reduction", p["reduction"]))
        if a["gap"].get("before"):
            truths.append(a["gap"]["closed_by_truth"])
        if all(gap.get(k) is not None for k in ("before", "after", "floor")):
            if gap["before"] - gap["floor"] > 0.05 * gap["floor"]:
                shares.append((gap["before"] - gap["after"]) / (gap["before"] - gap["floor"]))
        elif a["gap"]["closed_by_truth"] > 0.05:
            shares.append(p["reduction"] / a["gap"]["closed_by_truth"])
    return {
        "gap_closed": m.average(shares, np.median),
        "gap_reduction": m.average(reductions, np.median),
        "gap_closed_by_truth": m.average(truths, np.median),
        "gap_negative": m.share(r < -0.01 for r in reductions),
    }


def confusion(cases):
    """Rows: truth, columns: what is put first; counts over singles, none, unknown and left-out cases."""
    index = {c: i for i, c in enumerate(m.CLASSES)}
    counts = np.zeros((len(index), len(index)), int)
    for a, p in cases:
        if a["kind"] in ("single", "none", "unknown", "left_out"):
            truth = a["effects"][0] if a["kind"] == "single" else m.true_class(a)
            said = m.first(p, a)
            # a merged class counts for whichever member is the truth
            said = truth if said == m.merged(truth, a) else said
            counts[index[truth], index.get(said, index["unknown"])] += 1
    return {"classes": list(m.CLASSES), "counts": counts.tolist()}


def meets(key, figure):
    """Whether a figure reaches its target; None without data."""
    _, target, larger = TARGETS[key]
    value = figure.get("value")
    if value is None:
        return None
    if key == "coverage90":
        return 0.85 <= value <= 0.95
    return value >= target if larger else value <= target


def provenance(command, commit=None, machine=None):
    """Command, commit, machine and date that stand beside the figures; `commit` and `machine` of the diagnosis where it
    ran elsewhere."""
    import os

    here = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return {
        "command": command,
        "commit": commit or here.stdout.strip() or "unknown",
        "machine": machine or f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "date": date.today().isoformat(),
    }


def markdown(result):
    """The committed table."""
    out = [
        f"# {result['title']}",
        "",
        *(f"* {k}: `{v}`" for k, v in result["provenance"].items()),
        f"* cases: {result['cases']}",
        f"* SHA-256 of the answers: `{result['answers_sha256']}`",
        "",
        "Intervals are 95 % (Wilson for shares, bootstrap over cases for the rest).",
        "",
        "| figure | target | measured | 95 % | n | reached |",
        "|---|---|---|---|---|---|",
    ]

    def number(value):
        return "-" if value is None else f"{value:.3f}"

    for key, (what, target, larger) in TARGETS.items():
        f = result["figures"].get(key, {"value": None, "low": None, "high": None, "n": 0})
        sign = "≥" if larger else "≤"
        extra = f" ({f['class']})" if f.get("class") else ""
        spread = f"{number(f['low'])} to {number(f['high'])}"
        reached = {True: "yes", False: "no", None: "-"}[meets(key, f)]
        out.append(
            f"| {what}{extra} | {sign} {target} | {number(f['value'])} | {spread} | {f['n']} | {reached} |"
        )
    out += ["", "## Beyond the targets", "", "| figure | measured | 95 % | n |", "|---|---|---|---|"]
    for key, f in result["figures"].items():
        if key not in TARGETS:
            out.append(
                f"| {key} | {number(f['value'])} | {number(f['low'])} to {number(f['high'])} | {f['n']} |"
            )
    out += [
        "",
        "## By severity (single causes, top-1)",
        "",
        "| severity | top-1 | 95 % | n |",
        "|---|---|---|---|",
    ]
    for s, f in result["per_severity"].items():
        out.append(f"| {s} | {number(f['value'])} | {number(f['low'])} to {number(f['high'])} | {f['n']} |")
    out += ["", "## By class", "", "| class | top-1 | 95 % | top-2 | n |", "|---|---|---|---|---|"]
    for name, f in result["per_class"].items():
        t, second = f["top1"], number(f["top2"]["value"])
        spread = f"{number(t['low'])} to {number(t['high'])}"
        out.append(f"| {name} | {number(t['value'])} | {spread} | {second} | {t['n']} |")
    return "\n".join(out) + "\n"


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--predictions", type=Path, required=True)
    parser.add_argument("--reports", type=Path)
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/results/withheld"), help="path without ending"
    )
    parser.add_argument("--title", default="Check on withheld causes")
    parser.add_argument(
        "--command", default=" ".join(["python -m experiments.withheld.score", *sys.argv[1:]])
    )
    parser.add_argument("--commit", help="of the diagnosis, if it isn't this one")
    parser.add_argument("--machine", help="of the diagnosis, if it isn't this one")
    options = parser.parse_args()
    text = options.answers.read_text()
    answers = json.loads(text)
    predictions = json.loads(options.predictions.read_text())
    reports = json.loads(options.reports.read_text()) if options.reports and options.reports.exists() else {}
    result = score(answers["cases"], predictions, reports)
    result |= {
        "title": options.title,
        "provenance": provenance(options.command, options.commit, options.machine),
        "seed": answers.get("seed"),
        "scale": answers.get("scale"),
        "bands": answers.get("bands"),
        "floor": answers.get("floor"),
        "answers_sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Path(f"{options.out}.json").write_text(json.dumps(result, indent=1))
    Path(f"{options.out}.md").write_text(markdown(result))
    try:
        from experiments.withheld import score_figures
    except ImportError as missing:  # a bare compute node: the figures can be drawn later from the same files
        print(f"no figures: {missing}")
    else:
        score_figures.draw(result, options.out)
    print(markdown(result))


if __name__ == "__main__":
    main()
