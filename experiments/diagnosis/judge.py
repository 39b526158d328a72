"""Whether a report is right about one case: what it says, which names are right for the answer, which are no mistake.

What is read of `report.json`: `verdict`; `effects` (names, best first; "unknown" may stand among them); `probabilities`;
`parameters` {effect: {name: {value, interval90}}}; `contradictions` (a list: the channels that contradict each other). A log
that is refused with a one-line reason counts as called garbage too.
"""

import argparse
import json
from pathlib import Path

from experiments.diagnosis.effects import EFFECTS

GARBAGE_VERDICTS = ("garbage", "contradictory", "contradiction", "inconsistent", "refused")
GARBAGE = "garbage"
CAPTURE = 2.5  # ms that a motion capture may be late by itself


def reports_parser(doc):
    """A command line that takes the answers and what `experiments.diagnosis.diagnose` wrote."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("answers", type=Path)
    parser.add_argument("diagnoses", type=Path)
    return parser


def collect(diagnoses):
    """{case: prediction} from the folder that `experiments.diagnosis.diagnose` wrote."""
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
        strange = set(answer["effects"]) - set(
            EFFECTS
        )  # acts, but less than is asked for: naming it is no mistake
        wrong = "unknown" in said and not strange
        out["right"] = not lost and not wrong and not [n for n in names if n not in allowed]
    elif category == "single":
        out["right"] = not lost and _first_right(answer, names, allowed)
        out["extra"] = _extra(answer, names, allowed)
    else:
        out["f1"] = _set_f1(answer, names, allowed)
        out["right"] = out["f1"] == 1.0
    return out


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
