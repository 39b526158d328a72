"""Open the answers and score what the diagnosis wrote.

    python -m experiments.diagnosis.score ANSWERS.json DIAGNOSES [--title "Stranger's column"] [--misses]

prints the table; `score` and `collect` give the figures as plain data. Every share carries its 95 % interval (Wilson
1927), every median one by bootstrap. A case of the answers without a report is a miss in all figures.
"""

import json
import math
import re
from pathlib import Path

import numpy as np

from experiments.diagnosis.judge import collect, judge, reports_parser, top_probability
from experiments.diagnosis.magnitudes import before_thrust, gap_said, parameters, share_errors

# key -> (what, goal, whether larger is better)
FIGURES = {
    "top1": ("single cause: first name right", 0.92, True),
    "top1_medium_high": ("the same, medium and high severity", 0.97, True),
    "nothing_extra": ("single cause: nothing else named", 0.90, True),
    "false_unknown": ("a named effect is the cause: called unknown", 0.03, False),
    "none": ("none: nothing named", 0.97, True),
    "not_testable": ("not testable: nothing named", 0.95, True),
    "unknown_recall": ("unknown: called unknown", 0.80, True),
    "unknown_wrong_name": ("unknown: a wrong name given", 0.10, False),
    "garbage": ("garbage: called garbage", 0.95, True),
    "false_garbage": ("good logs: called garbage or refused", 0.02, False),
    "pair_exact": ("two causes: exactly both", 0.80, True),
    "pair_f1": ("two causes: F1 of the set", None, True),
    "single_or_none": ("single or none: right", None, True),
    "share_error": ("error of the true effect's share where it is named, median", 0.05, False),
    "share_error_all": ("the same, of all (0 where it isn't named)", None, False),
    "coverage": ("coverage of 90 % intervals (.85 to .95)", 0.85, True),
    "half_width": ("their half-width at medium severity, of the value, median", 0.15, False),
    "parameter_error": ("relative error of the parameters, median", None, False),
    "gap_closed": ("gap closed, of what the truth closes, both by the plant's measure, median", 0.80, True),
    "gap_said": (
        "gap closed as the report says, of what the truth closes by the plant's measure, median",
        None,
        True,
    ),
    "before_thrust": ("mass or thrust off by 5 to 10 %: gap before, in floors, median", 3.0, True),
    "calibration_error": ("calibration error of the most probable class", 0.05, False),
    "traceback": ("cases that end in a traceback", 0.0, False),
    "seconds": ("seconds a case after the first of a process, median", 5.0, False),
    "seconds_95": ("the same, 95th percentile", None, False),
}


def wilson(hits, n, z=1.96):
    """95 % interval of a proportion; (0, 1) without data."""
    if n == 0:
        return 0.0, 1.0
    p, d = hits / n, 1 + z * z / n
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, (centre - half) / d), min(1.0, (centre + half) / d)


def share(flags):
    """{"value", "low", "high", "n"} of booleans."""
    flags = [bool(f) for f in flags]
    low, high = wilson(sum(flags), len(flags))
    return {"value": sum(flags) / len(flags) if flags else None, "low": low, "high": high, "n": len(flags)}


def average(values, statistic=np.median, rounds=1000):
    """A statistic of numbers with its bootstrap 95 % interval over cases."""
    values = np.asarray([v for v in values if v is not None and np.isfinite(v)], float)
    if len(values) == 0:
        return {"value": None, "low": None, "high": None, "n": 0}
    drawn = values[np.random.default_rng(0).integers(0, len(values), (rounds, len(values)))]
    low, high = np.percentile(statistic(drawn, axis=1), [2.5, 97.5])
    return {"value": float(statistic(values)), "low": float(low), "high": float(high), "n": len(values)}


def calibration(pairs, bins=10):
    """Expected calibration error of (stated probability, whether true), and {stated, seen, n} per tenth."""
    if not pairs:
        return None, []
    p, hit = np.array(pairs, float).T
    slot = np.minimum((p * bins).astype(int), bins - 1)
    rows = [
        {
            "stated": float(p[slot == i].mean()),
            "seen": float(hit[slot == i].mean()),
            "n": int((slot == i).sum()),
        }
        for i in range(bins)
        if (slot == i).any()
    ]
    return sum(r["n"] * abs(r["stated"] - r["seen"]) for r in rows) / len(p), rows


def score(answers, predictions, closed=None):
    """{"figures": {key: {value, low, high, n}}, "per_effect", "per_unknown", …, "reliability", "counts", "cases"}.

    `closed`: {case: share} of `experiments.diagnosis.closed`.
    """
    lost = {"report": None, "traceback": "no report", "seconds": None, "first": False, "status": None}
    cases = {n: (a, predictions.get(n, lost)) for n, a in sorted(answers.items())}
    judged = {n: judge(a, p) for n, (a, p) in cases.items()}

    def of(*categories):
        return [n for n in cases if cases[n][0]["category"] in categories]

    def right(names):
        return share(judged[n]["right"] for n in names)

    single, good = of("single"), [n for n in cases if cases[n][0]["category"] != "garbage"]
    strong = [n for n in single if cases[n][0]["severity"] in ("medium", "high")]
    later = [p["seconds"] for _, p in cases.values() if p["seconds"] is not None and not p["first"]]
    measured = [row for n in of("single", "pair") for row in parameters(*cases[n])]
    shares = [row for n in of("single", "pair") for row in share_errors(*cases[n])]
    error, reliability = calibration([x for n in good if (x := top_probability(*cases[n])) is not None])
    figures = {
        "top1": right(single),
        "top1_medium_high": right(strong),
        "nothing_extra": share(not judged[n]["extra"] for n in single),
        "false_unknown": share("unknown" in judged[n]["said"] for n in of("single", "pair")),
        "none": right(of("none")),
        "not_testable": right(of("not_testable")),
        "unknown_recall": right(of("unknown")),
        "unknown_wrong_name": share(judged[n]["wrong_name"] for n in of("unknown")),
        "garbage": right(of("garbage")),
        "false_garbage": share(judged[n]["garbage"] for n in good if not cases[n][0].get("in_sensors")),
        "pair_exact": right(of("pair")),
        "pair_f1": average([judged[n]["f1"] for n in of("pair")], np.mean),
        "single_or_none": right(of("single", "none")),
        "share_error": average([abs(r["said"] - r["true"]) for r in shares if r["named"]]),
        "share_error_all": average([abs(r["said"] - r["true"]) for r in shares]),
        "coverage": share(c for r in measured for c in r["covered"]),
        "half_width": average([w for r in measured if r["severity"] == "medium" for w in r["half_widths"]]),
        "parameter_error": average([r["error"] for r in measured]),
        "gap_closed": average(
            [closed.get(n, 0.0) for n in strong if cases[n][0]["effects"][0] != "packet_loss"]
            if closed
            else []
        ),
        "gap_said": average([x for n in strong if (x := gap_said(*cases[n])) is not None]),
        "before_thrust": average([x for n in single if (x := before_thrust(*cases[n])) is not None]),
        "calibration_error": {
            "value": error,
            "low": None,
            "high": None,
            "n": sum(r["n"] for r in reliability),
        },
        "traceback": share(p["traceback"] is not None for _, p in cases.values()),
        "seconds": average(later),
        "seconds_95": average(later, lambda x, axis=None: np.percentile(x, 95, axis=axis)),
    }

    def table(key, names):
        groups = {}
        for n in names:
            groups.setdefault(str(key(cases[n][0])), []).append(n)
        return {k: right(v) for k, v in sorted(groups.items())}

    return {
        "figures": figures,
        "per_effect": table(lambda a: a["effects"][0], single),
        "per_severity": table(lambda a: a["severity"], single),
        "per_unknown": table(lambda a: a["effects"][0], of("unknown")),
        "per_garbage": table(lambda a: a["effects"][0], of("garbage")),
        "per_sensors": table(lambda a: a["sensors"]["kind"], of("single", "none")),
        "per_rate": table(lambda a: a["sensors"]["rate"], of("single", "none")),
        "per_turbulence": table(lambda a: a["sensors"]["turbulence"], of("single", "none")),
        "per_motor_columns": table(lambda a: a["sensors"].get("motor"), of("single", "none")),
        "per_controller": table(lambda a: a["controller"], of("single", "none")),
        "per_missing": table(
            lambda a: "".join(c for c in "pgacmv" if c not in a["sensors"]["channels"]), of("single", "none")
        ),
        "reliability": reliability,
        "counts": {c: len(of(c)) for c in dict.fromkeys(a["category"] for a, _ in cases.values())},
        "cases": judged,
    }


def number(value):
    return "–" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def cell(f, goal=None, larger=True):
    """One figure with its interval and n; bold where the goal is reached."""
    if f["value"] is None:
        return "–"
    met = goal is not None and (f["value"] >= goal if larger else f["value"] <= goal)
    star = "**" if met else ""
    inside = f"{number(f['low'])}–{number(f['high'])}, {f['n']}" if f["low"] is not None else f"{f['n']}"
    return f"{star}{number(f['value'])}{star} [{inside}]"


def groups(result):
    """Paragraphs that say where the misses lie."""
    lines = []
    for key, what in (
        ("per_effect", "Single causes, right"),
        ("per_severity", "By severity"),
        ("per_unknown", "Unknown kinds, called unknown"),
        ("per_garbage", "Garbage, called garbage"),
        ("per_sensors", "Single or none, right, by sensors"),
        ("per_rate", "By log rate, Hz"),
        ("per_turbulence", "By turbulence"),
        ("per_motor_columns", "By motor columns, mean over the row or snapshot"),
        ("per_controller", "By controller"),
        (
            "per_missing",
            "By missing channels (p pose, g gyroscope, a accelerometer, c commands, m motors, v voltage)",
        ),
    ):
        parts = [
            f"{k or 'none missing'} {round(v['value'] * v['n'])}/{v['n']}" for k, v in result[key].items()
        ]
        if parts:
            lines += [f"{what}: " + ", ".join(parts) + ".", ""]
    return lines


def markdown(title, result):
    """The table of one column, and where the misses lie."""
    lines = [f"## {title}", "", "cases: " + ", ".join(f"{n} {c}" for c, n in result["counts"].items()), ""]
    lines += ["| figure | goal | value [95 %, n] |", "|---|---|---|"]
    for key, (what, goal, larger) in FIGURES.items():
        aim = "" if goal is None else f"{'≥' if larger else '≤'} {goal:g}"
        lines.append(f"| {what} | {aim} | {cell(result['figures'][key], goal, larger)} |")
    return "\n".join([*lines, "", *groups(result)]) + "\n"


def misses(answers, result, predictions):
    """One line per case that is not right."""
    out = []
    for name, j in result["cases"].items():
        if j["right"] and not j.get("extra"):
            continue
        a, p = answers[name], predictions.get(name, {})
        s = a["sensors"]
        why = (p.get("traceback") or p.get("error") or "").strip().splitlines()[-1:] or [""]
        why = re.sub(r"\S*/", "", why[0])[:160]  # without the folders
        truth = (
            "+".join(f"{c['effect']}({c['form']})" for c in a["causes"]) or "+".join(a["effects"]) or "none"
        )
        said = "+".join(j["names"] + [w for w in j["said"] if w not in j["names"]]) or "nothing"
        flown = "/".join("+".join(m) for m in a["missions"])
        log = f"{s['kind']} {s['rate']} Hz {s['channels']} turbulence {s['turbulence']} {a['controller']} {flown}"
        size = f"{a['severity'] or ''} {a['severity_ratio']:.1f}"
        out.append(f"{name} {a['category']} {size}: {truth} -> {said} | {log} {why}")
    return out


def main():
    parser = reports_parser(__doc__)
    parser.add_argument("--closed", type=Path, help="what experiments.diagnosis.closed wrote")
    parser.add_argument("--title", default="Exam")
    parser.add_argument("--misses", action="store_true", help="one line per case that is not right")
    options = parser.parse_args()
    answers, predictions = json.loads(options.answers.read_text())["cases"], collect(options.diagnoses)
    closed = json.loads(options.closed.read_text()) if options.closed else None
    result = score(answers, predictions, closed)
    print(markdown(options.title, result))
    if options.misses:
        print("\n".join(misses(answers, result, predictions)))


if __name__ == "__main__":
    main()
