"""Open the answers and score what the diagnosis wrote.

    python -m experiments.exam.score ANSWERS.json DIAGNOSES [--title "Stranger's column"] [--misses]

prints the table; `score` and `collect` give the figures as plain data. Every share carries its 95 % interval (Wilson
1927), every median one by bootstrap. A case of the answers without a report is a miss in all figures.

What is read of `report.json`: `verdict`; `effects` (names, best first; "unknown" may stand among them); `probabilities`;
`parameters` {effect: {name: {value, interval90}}}; `shares` {"effects": {effect: {value, interval90}}, "sensors": …} of the
gap's mean square; `gap` {before, after, floor, reduction}, in floors; `contradictions` (a list: the channels that
contradict each other). A log that is refused with a one-line reason counts as called garbage too.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from experiments.exam.vehicle import GRAVITY, PROPELLER

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
    "share_error": ("error of the true effect's share, median", 0.05, False),
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
GARBAGE_VERDICTS = ("garbage", "contradictory", "contradiction", "inconsistent", "refused")
GARBAGE = "garbage"
CAPTURE = 2.5  # ms that a motion capture may be late by itself


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


def collect(diagnoses):
    """{case: prediction} from the folder that `experiments.exam.diagnose` wrote."""
    diagnoses = Path(diagnoses)
    runs = json.loads((diagnoses / "runs.json").read_text())
    out = {}
    for name, facts in runs.items():
        path = diagnoses / name / "report.json"
        ended = facts["traceback"] is None and facts["status"] == 0
        out[name] = facts | {"report": json.loads(path.read_text()) if ended and path.exists() else None}
    return out


def answer_of(prediction):
    """(names, first word, garbage): effects named without "unknown", the set of words said, whether it is called garbage."""
    report = prediction["report"]
    if report is None:
        refused = prediction["traceback"] is None
        return [], {GARBAGE} if refused else {"traceback"}
    words = [e for e in report.get("effects") or [] if e != "none"]
    if report.get("verdict") in GARBAGE_VERDICTS or (report.get("contradictions") and not words):
        return [], {GARBAGE}
    said = set(words)
    if report.get("verdict") == "unknown":
        said.add("unknown")
    return [w for w in words if w != "unknown"], said


def fine(answer, report=None):
    """Names that are no mistake in this case, though they are not its cause."""
    out = set(answer["also_fine"])
    if held := answer.get("held_ms"):
        said = ((report or {}).get("parameters") or {}).get("state_latency") or {}
        late = (said.get("delay") or {}).get("value")
        if late is not None and 1e3 * late <= held + CAPTURE:
            out.add(
                "state_latency"
            )  # rows that repeat a pose are late: by half the hold on average, the whole at most
    if "blade_flapping" in answer["effects"]:
        out.add("rotor_drag")  # its tilted thrust is drag in every sensor
    if "wind" in answer["effects"]:
        out.add("rotor_drag")  # air that pushes also brakes
    return out


def accepted(answer):
    """{true effect: set of names that are right for it}."""
    return {t: set(answer["acceptable"].get(t, [t])) for t in answer["expected"]}


def _first_right(answer, names, fine):
    right = next(iter(accepted(answer).values()))
    first = next((n for n in names if n in right or n not in fine), None)
    return first in right


def _extra(answer, names, fine):
    right = set().union(*accepted(answer).values())
    return [n for n in names if n not in right and n not in fine]


def _set_f1(answer, names, fine):
    groups = list(accepted(answer).values())
    hits = sum(any(n in g for n in names) for g in groups)
    wrong = len(_extra(answer, names, fine))
    return 2 * hits / (2 * hits + wrong + len(groups) - hits) if hits else 0.0


def judge(answer, prediction):
    """Whether one case is right, and what was said: {"right", "said", ...} by its category."""
    names, said = answer_of(prediction)
    category, allowed = answer["category"], fine(answer, prediction["report"])
    out = {"category": category, "said": sorted(said), "names": names, "garbage": GARBAGE in said}
    lost = bool(said & {GARBAGE, "traceback"})
    if category == "garbage":
        out["right"] = GARBAGE in said
    elif category == "unknown":
        # a sensor that misreads may be called a contradiction of the sensors just as well
        out["right"] = "unknown" in said or (GARBAGE in said and answer.get("in_sensors", False))
        out["wrong_name"] = bool([n for n in names if n not in allowed])
    elif category in ("none", "not_testable"):
        out["right"] = not lost and "unknown" not in said and not [n for n in names if n not in allowed]
    elif category == "single":
        out["right"] = not lost and _first_right(answer, names, allowed)
        out["extra"] = _extra(answer, names, allowed)
    else:
        out["f1"] = _set_f1(answer, names, allowed)
        out["right"] = out["f1"] == 1.0
    return out


def score(answers, predictions, closed=None):
    """{"figures": {key: {value, low, high, n}}, "per_effect", "per_unknown", …, "reliability", "counts", "cases"}.

    `closed`: {case: share} of `experiments.exam.closed`.
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
        "share_error": average([abs(r["said"] - r["true"]) for r in shares]),
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


def top_probability(answer, prediction):
    """(probability of the most probable class, whether it is the true one), or None without a report."""
    report = prediction["report"]
    said = {} if report is None else report.get("probabilities") or {}
    if not said:
        return None
    category = answer["category"]
    groups = (
        [set().union(*accepted(answer).values())]
        if category in ("single", "pair")
        else [set(answer["expected"])]
    )
    merged = dict(said)
    members = [n for n in said if n in groups[0]]
    if members:
        merged = {n: p for n, p in said.items() if n not in groups[0]} | {"*": sum(said[n] for n in members)}
    best = max(merged, key=merged.get)
    return min(float(merged[best]), 1.0), best == "*"


def share_errors(answer, prediction):
    """[{"effect", "said", "true"}] of the true effects' shares of the gap's mean square over the floor, where the report
    gives one; what the report leaves to the sensors is no part of the whole here.
    """
    said = (prediction["report"] or {}).get("shares") or {}
    rest = 1.0 - (said.get("sensors") or {}).get("value", 0.0)
    shares, out, energy = said.get("effects", {}), [], answer.get("energy")
    if not energy or rest <= 0.02:
        return out
    total, truth = sum(energy["nominal"]), sum(energy["truth"])
    for effect in answer["effects"]:
        entry = next(
            (shares[n] for n in [effect, *answer["acceptable"].get(effect, [])] if n in shares), None
        )
        if entry is not None and effect in energy:
            true = (sum(energy[effect]) - truth) / total
            out.append({"effect": effect, "said": float(entry["value"]) / rest, "true": true})
    return out


def gap_said(answer, prediction):
    """What the report closes of the gap's excess, over what the true effect closes of it by the plant's measure."""
    gap, truth = (prediction["report"] or {}).get("gap"), answer["gap"]["closed_by_truth"]
    if truth <= 0.02:
        return None
    if not gap or gap.get("reduction") is None:
        return 0.0
    return float(gap["reduction"]) / truth


def before_thrust(answer, prediction):
    """The report's gap before, in floors, of a mass or thrust that is off by 5 to 10 %."""
    cause = next(c for c in answer["causes"] if c["effect"] == answer["effects"][0])
    if cause["effect"] not in ("mass", "thrust_scale") or not 0.05 <= cause["size"] <= 0.10:
        return None
    gap = (prediction["report"] or {}).get("gap") or {}
    return float(gap["before"]) if gap.get("before") is not None else 0.0


def _lag(magnitudes, told):
    return {f"extra_{k}": magnitudes[f"tau_{k}"] - told["motor_time"] for k in ("up", "down")}


def _imbalance(magnitudes, told):
    e = np.array(magnitudes["e"])
    return dict(zip(("m1", "m2", "m3", "m4"), (e - e.mean()).tolist(), strict=True))


def _lateness(magnitudes, told):
    # what a log can show: the cause and the motion capture's own delay; nothing where poses are held
    late = magnitudes.get("logged_ms", magnitudes["delay_ms"])
    return {} if late is None else {"delay": 1e-3 * late}


# effect: (forms that mean the same in the library, true parameters by the library's names, the value that means "absent")
TRUTH = {
    "mass": (("plain",), lambda m, t: {"extra": m["mass_kg"] - t["mass"]}, 0.0),
    "thrust_scale": (("plain", "thrust_only"), lambda m, t: {"scale": m["scale"]}, 0.0),
    "battery_sag": (
        ("linear",),
        lambda m, t: {"exponent": m["thrust_per_volt"] * m["reference_voltage"]},
        0.0,
    ),
    "thrust_saturation": (("hard",), lambda m, t: {"limit": m["limit"]}, 1.0),
    "rotor_drag": (("linear", "raised_hub", "rotor_speed"), lambda m, t: {"d_xy": m["d_xy"]}, 0.0),
    "blade_flapping": (("linear",), lambda m, t: {"stiffness": m["torque_N_m_per_m_s"]}, 0.0),
    "motor_lag": (("slower", "up_down"), _lag, 0.0),
    "command_latency": (("constant", "jitter"), lambda m, t: {"delay": 1e-3 * m["delay_ms"]}, 0.0),
    "packet_loss": (("independent", "bursts"), lambda m, t: {"probability": m["probability"]}, 0.0),
    "thrust_curve": (("quadratic",), lambda m, t: {"curvature": m["curvature"]}, 0.0),
    "motor_imbalance": (("all", "one_weak"), _imbalance, 0.0),
    "com_offset": (("torque", "full"), lambda m, t: {"x": 1e-3 * m["x_mm"], "y": 1e-3 * m["y_mm"]}, 0.0),
    "inertia": (("diagonal",), lambda m, t: dict(zip(("xx", "yy", "zz"), m["ratio"], strict=True)), 1.0),
    "yaw_torque": (("scale",), lambda m, t: {"ratio": m["ratio"]}, 1.0),
    "rate_gains": (("gains",), lambda m, t: {"p": m["kp"]}, 1.0),
    "state_latency": (("constant", "jitter"), _lateness, 0.0),
}


def parameters(answer, prediction):
    """[{"effect", "error", "covered", "half_widths", "severity"}] of the true causes whose parameters the report gives.

    The error is |estimate - truth| / |truth - absent|, vectors taken as one; surface effects and wakes are compared as
    what they do at one distance.
    """
    said, rows = (prediction["report"] or {}).get("parameters") or {}, []
    for cause in answer["causes"]:
        effect, magnitudes = cause["effect"], cause["magnitudes"]
        fitted = said.get(effect)
        if not fitted:
            continue
        values = {k: v["value"] for k, v in fitted.items() if v.get("value") is not None}
        row = {"effect": effect, "severity": answer["severity"], "covered": [], "half_widths": []}
        derived = _derived(effect, cause, values)
        if derived is not None:
            estimate, true = derived
            rows.append(
                row | {"error": float(np.linalg.norm(np.subtract(estimate, true)) / np.linalg.norm(true))}
            )
            continue
        forms, truth_of, absent = TRUTH.get(effect, ((), None, 0.0))
        if cause["form"] not in forms:
            continue
        truth = truth_of(magnitudes, answer["told"])
        if not truth or not set(truth) <= set(values):
            continue
        estimate, true = np.array([values[k] for k in truth]), np.array(list(truth.values()))
        centre = (
            estimate.mean() if effect == "motor_imbalance" else 0.0
        )  # the common part is the thrust scale's
        size = float(np.linalg.norm(true - absent))
        for k, t in truth.items():
            interval = fitted[k].get("interval90")
            if interval:
                row["covered"].append(bool(interval[0] - centre <= t <= interval[1] - centre))
                row["half_widths"].append(
                    0.5 * (interval[1] - interval[0]) / max(abs(t - absent), 0.3 * size)
                )
        rows.append(row | {"error": float(np.linalg.norm(estimate - centre - true)) / size})
    return rows


def _derived(effect, cause, values):
    m = cause["magnitudes"]
    if effect in ("ground_effect", "ceiling_effect") and "strength" in values:
        return values["strength"] * (PROPELLER / (0.05 + values.get("offset", 0.0))) ** 2, m["gain_at_5cm"]
    if effect == "wind" and {"x", "y", "drag"} <= set(values) and cause["form"] == "steady":
        # the force at rest: speed and drag apart show far less than their product
        return values["drag"] * np.array([values["x"], values["y"]]), m["drag"] * np.array(
            [m["w_x"], m["w_y"]]
        )
    if effect == "downwash" and "force" in values and cause["form"] == "gaussian":
        length = values.get("length", 0.5)
        return values["force"] * np.exp(-0.25 / length), 1e-3 * GRAVITY * m["A_g"] * np.exp(
            -0.25 / m["height_m"]
        )
    return None


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
        truth = (
            "+".join(f"{c['effect']}({c['form']})" for c in a["causes"]) or "+".join(a["effects"]) or "none"
        )
        said = "+".join(j["names"] + [w for w in j["said"] if w not in j["names"]]) or "nothing"
        flown = "/".join("+".join(m) for m in a["missions"])
        log = f"{s['kind']} {s['rate']} Hz {s['channels']} turbulence {s['turbulence']} {a['controller']} {flown}"
        size = f"{a['severity'] or ''} {a['severity_ratio']:.1f}"
        out.append(f"{name} {a['category']} {size}: {truth} -> {said} | {log} {why[0][:160]}")
    return out


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("answers", type=Path)
    parser.add_argument("diagnoses", type=Path)
    parser.add_argument("--closed", type=Path, help="what experiments.exam.closed wrote")
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
