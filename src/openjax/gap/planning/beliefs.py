"""Beliefs after a diagnosis, from its `report.json`."""

import json
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.flights.segments import SEGMENTS
from openjax.gap.criteria import DETECTABLE
from openjax.gap.decision import DECISION
from openjax.gap.model.library import ABSENT, CARDS, PLACE, places
from openjax.gap.planning.information import SECONDS, Advice, Belief, advise
from openjax.vehicle.vehicle_file import VehicleFile

SCALE_ONLY = {"mass", "thrust_scale", "thrust_curve"}
"""A scale tells these apart, no flight."""


def read_report(folder: Path) -> dict:
    """The `report.json` of a diagnosis. Raises UserError where there is none that can
    be read.
    """
    path = folder / "report.json" if folder.is_dir() else folder
    if not path.is_file():
        raise UserError(
            f"{folder}: holds no report.json; openjax diagnose FLIGHTS writes one into diagnosis/"
        )
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError):
        raise UserError(f"{path}: isn't JSON; diagnose the flights again") from None
    if not isinstance(report, dict) or not {"probabilities", "parameters"} <= set(report):
        if isinstance(report, dict) and "rotors" in report:
            raise UserError(
                f"{path}: compares trims alone, and no flight tells more of them; diagnose flights "
                "with attitude or gyroscope"
            )
        raise UserError(f"{path}: not a report of openjax diagnose")
    return report


def beliefs_of(report: dict) -> list[Belief]:
    """The likeliest causes of a report and what these flights couldn't show,
    normalised. Only what acts between motors and motion: other effects are read from
    the commands' own columns.
    """
    chances = report["probabilities"]
    causes = [e for e in report.get("effects", ()) if acts_in_physics(e)]
    chances_of: dict[tuple[str, ...], float] = {
        (): max(chances.get("none", 0.0), DECISION.least_belief)
    }
    # what a report names is believed together, as it was found together
    if causes:
        sure = max(chances.get(e, 0.0) for e in causes)
        chances_of[tuple(causes)] = max(sure, DECISION.least_belief)
        for effect in causes:
            for other in filter(acts_in_physics, report.get("equivalent", {}).get(effect, ())):
                # As likely as the one that it would do as well as.
                rest = tuple(e for e in causes if e != effect)
                chances_of[(*rest, other)] = max(chances.get(effect, 0.0), DECISION.least_belief)
    for effect, chance in chances.items():
        if acts_in_physics(effect) and effect not in causes and chance > DECISION.least_rival:
            chances_of.setdefault((effect,), chance)
    # what those flights couldn't show they don't speak against, either
    for effect in filter(acts_in_physics, report.get("not_testable", ())):
        chances_of.setdefault((effect,), DECISION.least_belief)
    whole = sum(chances_of.values())
    return [Belief(e, _theta(e, report["parameters"]), p / whole) for e, p in chances_of.items()]


def acts_in_physics(effect: str) -> bool:
    """True if an effect acts in the physics and needs no second vehicle, so that a segment may show
    it.
    """
    card = CARDS.get(effect)
    return card is not None and card.path == "physics" and not card.of_others


def beside_segments(effects, alone: bool) -> str:
    """Advice on flying and logging for the first of `effects` that no segment shows and these
    loggers can reach: who flies `alone` isn't sent for a second vehicle.
    """
    for effect in effects:
        if effect in CARDS and not acts_in_physics(effect):
            if not (alone and CARDS[effect].of_others):
                return f"{effect.replace('_', ' ')}: {CARDS[effect].next_flight}"
    return ""


def _theta(effects, parameters: dict) -> np.ndarray:
    """(P,) with the report's values, or an effect's usual start where the report has
    none.
    """
    theta = ABSENT.copy()
    for effect in effects:
        theta[places((effect,))] = [p.start for p in CARDS[effect].fitted]
        for name, estimate in parameters.get(effect, {}).items():
            if (effect, name) in PLACE:
                theta[PLACE[effect, name]] = estimate["value"]
    return theta


def advice_for(report: dict, vehicle_file: VehicleFile) -> tuple[str, Advice]:
    """Advice on the flight after a report (as `report.json`), in words and by segments. Raises
    UserError if nothing is left to tell apart.
    """
    beliefs = beliefs_of(report)
    if len(beliefs) < 2:
        raise UserError(
            "the report leaves one cause, and no flight is needed to tell it from others"
        )
    advice = advise(beliefs, vehicle_file)
    text = sentence(advice, report)
    if not is_open(beliefs):
        text = f"Little is left open, and no flight is needed. To be sure anyway: {text}"
    return text, advice


def is_open(beliefs: list[Belief]) -> bool:
    """True if enough is left open for a flight."""
    return 1.0 - sum(b.probability**2 for b in beliefs) >= DECISION.open_question


def next_flight(report: dict, vehicle_file: VehicleFile) -> str:
    """The flight to fly after a report, by the same rule as `openjax plan`; empty if too little is
    left open.
    """
    beliefs = beliefs_of(report)
    if not is_open(beliefs):
        return ""
    return sentence(advise(beliefs, vehicle_file), report)


def sentence(advice: Advice, report: dict) -> str:
    """The next step, and the reason for it."""
    best = advice.promises[0]
    hopeless = [pair for pair, nats in advice.nats.items() if nats < DETECTABLE]
    weigh = [pair for pair in hopeless if set(pair) <= SCALE_ONLY]
    causes = [cause for cause in best.pair if cause != "nothing"]
    question = f"whether {causes[0]} acts" if len(causes) == 1 else " from ".join(causes)
    text = (
        f"Fly {best.segment!r} next, {SEGMENTS[best.segment].shows}: {SECONDS:.0f} s of it are "
        f"enough to tell {question}."
    )
    if best.nats < DETECTABLE:
        text = f"No segment tells {question}."
    if weigh:
        text += f" No flight tells {weigh[0][0]} from {weigh[0][1]}: weigh the vehicle."
    if mends := _to_mend(report):
        text += f" Before that, {' and '.join(mends)}: otherwise no flight shows more."
    return text.replace("_", " ")


def _to_mend(report: dict) -> list[str]:
    """Changes of the log without which no flight is worth it."""
    remarks = report.get("identification", {}).get("remarks", ())
    issues = [entry["issue"] for entry in report.get("quality", ())]
    reasons = {
        "log the motors' means at 100 Hz": ("sample", remarks),
        "log motors and gyroscope on one clock": ("don't share a clock", report.get("sensors", ())),
        "log the accelerometer": ("only torques can be judged", issues),
    }
    return [mend for mend, (sign, texts) in reasons.items() if any(sign in text for text in texts)]
