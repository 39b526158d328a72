"""The whole diagnosis of one case: evidence, selection, shares, words, report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from openjax.flights.flight import Case, Flight, Issue
from openjax.gap import verdict as rules
from openjax.gap.evidence import Evidence, gather
from openjax.gap.hypotheses import SetFit
from openjax.gap.library import CARDS, PLACE, Library, library, path_of
from openjax.gap.report import Estimate, Report
from openjax.gap.rest import Rest, look
from openjax.gap.selection import CLASS, Selection, select
from openjax.gap.shares import ERROR_NAMES, split
from openjax.gap.table import BOUND, judge, with_effects
from openjax.gap.where import locate
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.vehicle_file import VehicleFile, load_vehicle_file

LEAST_ERROR = 0.01  # of a value, one standard deviation
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
        quality=[{"flight": i.flight, "issue": i.issue} for i in evidence.case.quality],
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


def estimates(evidence: Evidence, fit: SetFit, named) -> dict[str, dict[str, Estimate]]:
    """Parameters of the named effects with 90 % intervals, from the model or, where they disagree more, from the
    flights' own spread."""
    out = {}
    deviation = robust_deviation(fit)
    for effect in named:
        path = path_of(effect)
        values = {}
        for number, fitted in enumerate(CARDS[effect].fitted):
            parameter = EFFECTS[effect].parameters[fitted.name]
            if path == "physics":
                place = PLACE[effect, fitted.name]
                value, spread = float(fit.theta[place]), float(deviation[list(fit.index).index(place)])
                # The replay itself is no better than that.
                spread = float(np.hypot(spread, LEAST_ERROR * value))
            else:
                value, spread = _path_estimate(evidence, effect, number)
            reach = 1.645 * spread
            values[fitted.name] = Estimate(
                value, parameter.unit, (value - reach, value + reach), parameter.prior
            )
        out[effect] = values
    return out


def robust_deviation(fit: SetFit) -> np.ndarray:
    """Standard deviations (p,) of a fit's parameters: flight-wise sandwich where flights disagree more
    than they should."""
    model = np.sqrt(np.diag(fit.covariance))
    count = len(fit.grams)
    if count < 2 or not len(fit.index):
        return model
    pushes = fit.grams[:, 1:, 0] - fit.grams[:, 1:, 0].mean(0)
    middle = pushes.T @ pushes * count / (count - 1)
    sandwich = np.sqrt(np.maximum(np.diag(fit.covariance @ middle @ fit.covariance), 0.0))
    # Few flights: Student's quantile instead of the normal one.
    sandwich *= student.ppf(0.95, count - 1) / 1.645
    return np.clip(sandwich, model, 4.0 * model)


def _path_estimate(evidence: Evidence, effect: str, number: int) -> tuple[float, float]:
    if effect == "state_latency":
        _, theta, covariance = evidence.pose.score()
        return float(theta[0]), float(np.sqrt(covariance[0, 0]))
    if effect == "rate_gains":
        return 1.0 + float(evidence.gains.change[number]), float(evidence.gains.error[number])
    radio = evidence.radio
    if effect == "command_latency":
        return radio.delay, 0.0005
    n = max(radio.informative, 1)
    return radio.loss, float(np.sqrt(radio.loss * (1 - radio.loss) / n) + 0.5 / n)


def _rest_in_words(rest: Rest) -> str:
    words = [f"What is left isn't noise: {', '.join(rest.lines)}."] if rest.lines else []
    best = int(np.argmax(rest.predicted))
    if rest.predicted[best] <= rules.FOLLOWED or rest.nats < rules.LEAST_NATS:
        return " ".join(words)
    return (
        " ".join(words)
        + (" " if words else "")
        + (
            f"What is left in {ERROR_NAMES[best]} isn't noise: {100 * rest.predicted[best]:.0f} % of it follows "
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
