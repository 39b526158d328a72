"""What acts in a case, and whether a report is right about it.

The answers of a set are one JSON file, {"cases": {name: answer}}. An answer holds `category` (none,
single, pair, unknown, not_testable, garbage or real), `effects`, and optionally `acceptable` (the
names that are right for each effect: a list of lists, or {effect: names}), `expected` (the effects
that the logs show) and `also_fine` (names that are no mistake).
"""

import json
from dataclasses import dataclass
from pathlib import Path

NOTHING = ("none", "not_testable")
CONTRADICTORY = ("garbage", "contradictory", "contradiction", "inconsistent", "refused")
# Names that a true effect always carries: tilted thrust is drag in every sensor, air
# that pushes also brakes.
CARRIES = {"blade_flapping": "rotor_drag", "wind": "rotor_drag"}


@dataclass(frozen=True)
class Truth:
    """`right` holds the acceptable names of each effect that shows, strongest first; `fine` what is
    no mistake.
    """

    category: str
    effects: tuple[str, ...] = ()
    right: tuple[frozenset[str], ...] = ()
    fine: frozenset[str] = frozenset()
    in_sensors: bool = False


def truth_of(answer: dict) -> Truth:
    """The truth of one answer, in whichever of the forms above."""
    effects = tuple(answer["effects"])
    acceptable = answer.get("acceptable", {})
    if isinstance(acceptable, dict):
        shown = answer.get("expected", effects)
        acceptable = [acceptable.get(effect, [effect]) for effect in shown]
    fine = set(answer.get("also_fine", ())) | {CARRIES[e] for e in effects if e in CARRIES}
    named = answer["category"] in ("single", "pair", "real")
    right = tuple(frozenset(names) for names in acceptable) if named else ()
    return Truth(
        answer["category"], effects, right, frozenset(fine), answer.get("in_sensors", False)
    )


def read_answers(path: Path) -> dict[str, dict]:
    """Name -> answer from an answers file."""
    return json.loads(path.read_text())["cases"]


def words_of(report: dict | None) -> list[str]:
    """What a report says, best first: effects and "unknown", nothing for "none", "garbage" where it
    was refused.
    """
    if report is None:
        return ["garbage"]
    words = [e for e in report.get("effects") or [] if e != "none"]
    verdict = report.get("verdict")
    if verdict in CONTRADICTORY or (report.get("contradictions") and not words):
        return ["garbage"]
    return ["unknown", *words] if verdict == "unknown" and "unknown" not in words else words


def judge(truth: Truth, words: list[str]) -> dict:
    """Whether the `words` of a report are right: {"right", "wrong_names", "false_unknown"}."""
    names = [w for w in words if w not in ("unknown", "garbage")]
    allowed = truth.fine.union(*truth.right)
    wrong = [n for n in names if n not in allowed]
    lost = "garbage" in words
    first = next(
        (n for n in names if n not in truth.fine or any(n in r for r in truth.right)), None
    )
    if truth.category == "garbage":
        right = lost
    elif truth.category == "unknown":
        right = "unknown" in words or (lost and truth.in_sensors)
    elif truth.category in NOTHING:
        right = not lost and "unknown" not in words and not wrong
    elif truth.category == "pair" and len(truth.right) == 2:
        right = all(r.intersection(names) for r in truth.right) and not wrong
    else:  # of more than two causes any may come first
        leading = truth.right if truth.category == "pair" else truth.right[:1]
        right = any(first in r for r in leading)
    return {
        "right": right,
        "wrong_names": wrong,
        "false_unknown": bool(truth.right) and "unknown" in words,
    }


def right_names(truth: Truth) -> frozenset[str]:
    """The classes of which the most probable one may be: those that are right count as one, and
    where nothing need be named those that are no mistake count with "none", as in `judge`.
    """
    unnamed = {"unknown"} if truth.category == "unknown" else {"none"} | truth.fine
    return frozenset().union(*truth.right) or frozenset(unnamed)


def top_probability(right, probabilities: dict[str, float]) -> tuple[float, bool] | None:
    """(probability of the most probable class, whether it is the true one); the names that are
    `right` count as one.
    """
    if not probabilities:
        return None
    together = sum(p for name, p in probabilities.items() if name in right)
    best = max((p for name, p in probabilities.items() if name not in right), default=0.0)
    return max(together, best), together >= best
