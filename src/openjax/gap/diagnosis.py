"""The whole diagnosis of one case: evidence, selection, shares, words, report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from openjax.flights.flight import Case, Flight, Issue
from openjax.gap import verdict as rules
from openjax.gap.bounds import BOUND
from openjax.gap.evidence import Evidence, gather
from openjax.gap.intervals import estimates
from openjax.gap.judging import judge
from openjax.gap.library import CARDS, Library, library
from openjax.gap.report import Report
from openjax.gap.rest import Rest, look
from openjax.gap.selection import CLASS, Selection, select
from openjax.gap.shares import ERROR_NAMES, split
from openjax.gap.table import with_effects
from openjax.gap.where import locate
from openjax.vehicle.vehicle_file import VehicleFile, load_vehicle_file

# Pairs that motion alone can't split, whatever their scores, unless something was measured beforehand.
ALWAYS_EQUAL = (("mass", "thrust_scale"),)


def diagnose(
    flights: Sequence[Flight],
    vehicle: VehicleFile | None = None,
    without: Iterable[str] = (),
    name: str = "case",
    quality: Sequence[Issue] = (),
    progress=None,
) -> Report:
    """Diagnose flights of one vehicle (or of several of one build that flew together).

    flights as `load_case` gives them, `vehicle` their vehicle file (default: the nominal vehicle),
    `without` effects that the library must do without. Raises UserError where the flights are too short or
    hold no commands."""
    vehicle = load_vehicle_file() if vehicle is None else vehicle
    return diagnose_case(Case(name, tuple(flights), vehicle, tuple(quality)), without, progress)


def diagnose_case(case: Case, without: Iterable[str] = (), progress=None) -> Report:
    """`diagnose` for a loaded case. `progress(text)` is called as the work goes on."""
    begin = time.perf_counter()
    evidence = gather(case, library(without), progress)
    if progress:
        progress("trying every effect that the flights can show")
    return replace(conclude(evidence), seconds=time.perf_counter() - begin)


def conclude(evidence: Evidence) -> Report:
    """The report that the evidence supports."""
    selection = select(evidence)
    rest = look(evidence, selection)
    named = [*selection.effects, *rules.other_paths(evidence)]
    parts = split(evidence, selection, rest, named)
    material = [e for e in named if rules.shrinks(parts, e)]
    if material != named:
        parts = split(evidence, selection, rest, material)
    missing = rules.not_testable(evidence)
    found = rules.decide(evidence, selection, rest, parts, missing)
    named = [e for e in found.effects if e != "unknown"]
    parts = replace(parts, effects={e: parts.effects[e] for e in named})
    equivalent = equivalents(evidence, selection, named)
    chances = found.probabilities
    ranked = sorted(chances, key=lambda e: -chances[e])
    second = next(
        (e for e in ranked if e not in found.effects and not (e == "none" and not found.effects)), ""
    )
    splitter = next((o for e in named for o in equivalent.get(e, ())), missing[0] if missing else second)
    return Report(
        case=evidence.case.name,
        verdict=found.word,
        effects=found.effects,
        probabilities=chances,
        shares=parts,
        equivalent=equivalent,
        parameters=estimates(evidence, selection.fit, named),
        where=locate(evidence, selection.fit, named),
        gap=parts.gap,
        not_testable=missing,
        next_flight=CARDS[splitter].next_flight if splitter in CARDS else "",
        quality=[
            {"flight": i.flight, "issue": i.issue, "left_out": i.refused} for i in evidence.case.quality
        ],
        runner_up=f"{second} ({chances[second]:.2f})" if second and chances[second] > 0.01 else "",
        rest=_rest_in_words(rest),
        sensors=tuple(evidence.sensors.findings.values()),
        contradictions=tuple(f"{i.flight}: {i.issue}" for i in evidence.case.quality if i.kind == "garbage"),
        nuisances=_nuisances(evidence, selection),
        plots={"evidence": evidence, "selection": selection},
    )


def equivalents(evidence: Evidence, selection: Selection, named) -> dict[str, list[str]]:
    """For each named effect those that would do as well in its place."""
    out = {}
    for effect in named:
        others = [o for o, nats in selection.swaps.get(effect, {}).items() if nats > -CLASS]
        for pair in ALWAYS_EQUAL:
            if effect in pair and not evidence.case.vehicle_file.mass_weighed:
                others += [e for e in pair if e != effect and e in evidence.library.effects]
        if others:
            out[effect] = sorted(set(others))
    return out


def _rest_in_words(rest: Rest) -> str:
    words = [f"What is left isn't noise: {', '.join(rest.local)}."] if rest.local else []
    predicted = rest.everything.predicted
    best = int(np.argmax(predicted))
    if predicted[best] <= rules.FOLLOWED or rest.everything.nats < rules.LEAST_NATS:
        return " ".join(words)
    return (
        " ".join(words)
        + (" " if words else "")
        + (
            f"What is left in {ERROR_NAMES[best]} isn't noise: {100 * predicted[best]:.0f} % of it follows "
            f"{'; '.join(rest.followed)} on stretches left out."
        )
    )


def _nuisances(evidence: Evidence, selection: Selection) -> dict[str, str]:
    """What the vehicle's numbers and the sensors' mounting took, in usual sizes; a number at its bound says so."""
    names = np.array(evidence.replay.nuisance_names)[evidence.replay.shared]
    taken = judge(selection.table, with_effects(selection.table)).taken.mean(0)

    def at(v):
        return ", at its bound" if abs(v) > 0.99 * BOUND else ""

    return {n: f"{v:+.2f} of its usual size{at(v)}" for n, v in zip(names, taken, strict=True)}


__all__ = ["Library", "conclude", "diagnose", "diagnose_case", "library"]
