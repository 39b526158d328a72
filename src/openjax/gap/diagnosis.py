"""The whole diagnosis of one case: evidence, decision, estimates, report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student

from openjax.flights.flight import Case, Flight, Issue
from openjax.gap import decision as rules
from openjax.gap import gate
from openjax.gap.evidence import Evidence, gather
from openjax.gap.headroom import look_around
from openjax.gap.how_far import held_out_residuals, shrink
from openjax.gap.hypotheses import SetFit
from openjax.gap.library import FITS, PLACE, Library, library, path_of
from openjax.gap.linear_path import linear_score
from openjax.gap.report import Estimate, Report
from openjax.gap.rest import CHANNELS, Rest, look
from openjax.gap.where import locate
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.vehicle_file import VehicleFile, load_vehicle_file

EQUAL = 0.05  # share of the best set's probability at which a substitute counts as equivalent
# Pairs that motion alone can't split, whatever their scores, unless something was measured beforehand.
ALWAYS_EQUAL = (("mass", "thrust_scale"),)
NEXT_FLIGHT = {
    "mass": "weigh the vehicle, then hover and climb hard: a weighed mass leaves only the thrust.",
    "thrust_scale": "weigh the vehicle, then hover and climb hard: a weighed mass leaves only the thrust.",
    "battery_sag": "the same hover on a full and on a nearly empty battery.",
    "thrust_saturation": "short full-thrust climbs.",
    "thrust_curve": "steps of collective thrust between 40 and 90 %.",
    "rotor_drag": "fast straight passes in two headings, nose and side first.",
    "blade_flapping": "fast straight passes with sudden stops, to load roll and pitch.",
    "wind": "hover, turning slowly through a full circle of yaw.",
    "ground_effect": "slow passes between 3 and 20 cm above the floor.",
    "ceiling_effect": "slow passes just below the ceiling.",
    "downwash": "a second vehicle crossing 15 to 50 cm above.",
    "motor_lag": "roll, pitch and thrust doublets, as short as the vehicle allows.",
    "motor_imbalance": "hover and climbs at several thrusts, with yaw free.",
    "com_offset": "hover and climbs at several thrusts, with yaw free.",
    "inertia": "roll, pitch and yaw doublets with the motor commands logged.",
    "yaw_torque": "yaw doublets and steps.",
    "command_latency": "steps of commanded thrust and rates, with motor commands logged.",
    "packet_loss": "steps of commanded thrust and rates, with motor commands logged.",
    "rate_gains": "roll, pitch and yaw doublets with commands and motor commands logged.",
    "state_latency": "fast roll and pitch manoeuvres with pose and gyroscope logged.",
}


def diagnose(
    flights: Sequence[Flight],
    vehicle: VehicleFile | None = None,
    settings: rules.Settings | None = None,
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
    return diagnose_case(Case(name, tuple(flights), vehicle, tuple(quality)), settings, without, progress)


def diagnose_case(case: Case, settings=None, without: Iterable[str] = (), progress=None) -> Report:
    """`diagnose` for a loaded case. `progress(text)` is called as the work goes on."""
    begin = time.perf_counter()
    settings = rules.load_settings() if settings is None else settings
    evidence = gather(case, library(without), progress)
    if progress:
        progress("deciding")
    report = conclude(evidence, settings)
    return replace(report, seconds=time.perf_counter() - begin)


def conclude(evidence: Evidence, settings: rules.Settings) -> Report:
    """The report that the evidence supports."""
    first = rules.decide(evidence, None, settings)
    left = rules.best_fit(evidence, first.best)
    rest = look(evidence.replay, left)
    signs = signs_of(evidence, left, rest, first.best, settings) if settings.unknown else None
    found = rules.decide(evidence, signs, settings)
    unknown = found.unknown > settings.unknown_threshold
    effects = ("unknown", *_partly(evidence, found.best)) if unknown else found.best
    named = [e for e in effects if e != "unknown"]
    fit = rules.best_fit(evidence, named)
    held_out = held_out_residuals(evidence, fit)
    gap = shrink(evidence, held_out, named)
    missing = not_testable(evidence, settings)
    verdict = "unknown" if unknown else "effect" if effects else "none"
    if verdict == "none" and len(missing) >= len(evidence.library.effects) // 2:
        verdict = "not_testable"
    equivalent = equivalents(evidence, found, named)
    ranked = sorted(found.probabilities, key=lambda e: -found.probabilities[e])
    second = next((e for e in ranked if e not in effects and not (e == "none" and not effects)), "")
    chance = found.probabilities.get(second, 0.0)
    splitter = named[0] if named else (second if second in NEXT_FLIGHT else (missing[0] if missing else ""))
    return Report(
        case=evidence.case.name,
        verdict=verdict,
        effects=tuple(effects),
        probabilities=dict.fromkeys(EFFECTS, 0.0) | found.probabilities,
        equivalent=equivalent,
        parameters=estimates(evidence, fit, named, settings),
        where=locate(evidence, fit, named),
        gap=gap,
        not_testable=missing,
        next_flight=NEXT_FLIGHT.get(second if second in NEXT_FLIGHT and chance > 0.02 else splitter, ""),
        quality=[{"flight": i.flight, "issue": i.issue} for i in evidence.case.quality],
        runner_up=f"{second} ({chance:.2f})" if second else "",
        rest=_rest_in_words(rest) if unknown else "",
        nearest=_nearest(evidence, left, first.best, settings) if unknown else "",
        nuisances=_nuisances(evidence, fit),
        plots={"evidence": evidence, "fit": fit, "held_out": held_out, "rest": rest, "decision": found},
    )


def _nearest(evidence: Evidence, fit: SetFit, best, settings: rules.Settings) -> str:
    """What the known effects alone would say, in words: not an answer, but where to look."""
    if not fit.effects:
        return ""
    found = estimates(evidence, fit, fit.effects, settings)
    shown = [f"{e} ({', '.join(v.in_words(p) for p, v in own.items())})" for e, own in found.items()]
    gap = shrink(evidence, held_out_residuals(evidence, fit), best)
    return (
        f"Of the known effects these come nearest: {'; '.join(shown)}; with them the gap on held-out flights would go from "
        f"{gap.before:.2f} to {gap.after:.2f}."
    )


def signs_of(
    evidence: Evidence, fit: SetFit, rest: Rest, chosen, settings: rules.Settings
) -> dict[str, float]:
    """What the unknown gate weighs, about the fit of the chosen set."""
    left = left_by(evidence, fit, rest)
    nothing = left if not fit.effects else left_by(evidence, evidence.nothing)
    paths = rules.path_scores(evidence)
    return gate.features(left, nothing, paths, evidence.library.effects, chosen, settings.null)


def left_by(evidence: Evidence, fit: SetFit, rest: Rest | None = None) -> gate.Left:
    """What a fitted set leaves."""
    rest = look(evidence.replay, fit) if rest is None else rest
    room = gate.summary(look_around(evidence.replay, fit))
    taken = evidence.replay.nuisance_estimates([c[0] for c in fit.columns])
    size = min(map(len, taken))
    return gate.Left(rest.vector(), room, np.mean([t[:size] for t in taken], 0))


def _partly(evidence: Evidence, best) -> list[str]:
    """Of the named effects those that clearly explain a part although something unknown acts: the first,
    if any."""
    for effect in best:
        if path_of(effect) != "physics":
            return [effect]
    return []


def not_testable(evidence: Evidence, settings: rules.Settings) -> list[str]:
    """Effects of the library that, at a usual size, these flights would not show."""
    missing = [e for e in evidence.library.physics if evidence.exposure.get(e, 0.0) < settings.testable]
    if evidence.radio is None or evidence.radio.informative < 30:
        missing += [e for e in ("command_latency", "packet_loss") if e in evidence.library.effects]
    if evidence.rate_loop is None:
        missing += [e for e in ("rate_gains",) if e in evidence.library.effects]
    if evidence.pose is None:
        missing += [e for e in ("state_latency",) if e in evidence.library.effects]
    return missing


def equivalents(evidence: Evidence, found: rules.Decision, named) -> dict[str, list[str]]:
    """For each named effect those that would do nearly as well in its place."""
    top = max(found.posterior.values())
    out = {}
    for effect in named:
        rest = frozenset(found.best) - {effect}
        others = [
            next(iter(set(key) - rest))
            for key, p in found.posterior.items()
            if len(key) == len(found.best) and rest < frozenset(key) and effect not in key and p > EQUAL * top
        ]
        for pair in ALWAYS_EQUAL:
            weighed = evidence.case.vehicle_file.mass_weighed
            if effect in pair and not weighed:
                others += [e for e in pair if e != effect and e in evidence.library.effects]
        if others:
            out[effect] = sorted(set(others))
    return out


def estimates(evidence: Evidence, fit: SetFit, named, settings) -> dict[str, dict[str, Estimate]]:
    """Parameters of the named effects with 90 % intervals: the larger of the model's and the flights' own
    spread, and what an inexact form and the nuisances leave besides, a share of the effect's size."""
    out = {}
    deviation = robust_deviation(fit)
    for effect in named:
        path = path_of(effect)
        values = {}
        for number, fitted in enumerate(FITS[effect].parameters):
            parameter = EFFECTS[effect].parameters[fitted.name]
            if path == "physics":
                place = PLACE[effect, fitted.name]
                value, spread = float(fit.theta[place]), float(deviation[list(fit.index).index(place)])
            else:
                value, spread = _path_estimate(evidence, effect, number)
            share = settings.form_error.get(effect, settings.usual_form_error)
            reach = 1.645 * float(np.hypot(spread, share * abs(value - parameter.none)))
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
        _, theta, covariance = evidence.rate_loop.score()
        spread = np.sqrt(covariance[number, number])
        per_flight = np.array(
            [linear_score(g, evidence.rate_loop.spread)[1][number] for g in evidence.rate_loop.grams]
        )
        if len(per_flight) > 1:
            spread = max(spread, per_flight.std(ddof=1) / np.sqrt(len(per_flight)))
        return 1.0 + float(theta[number]), float(spread)
    radio = evidence.radio
    if effect == "command_latency":
        return radio.delay, 0.0005
    n = max(radio.informative, 1)
    return radio.loss, float(np.sqrt(radio.loss * (1 - radio.loss) / n) + 0.5 / n)


def _rest_in_words(rest: Rest) -> str:
    best = int(np.argmax(rest.explained))
    if rest.explained[best] > 0.1:
        drivers = ", ".join(rest.drivers.get(CHANNELS[best], []))
        return (
            f"A flexible model predicts {100 * rest.explained[best]:.0f} % of the rest in "
            f"{CHANNELS[best].replace('_', ' ')} "
            f"on held-out flights, mostly from: {drivers}."
        )
    worst = int(np.argmax(rest.bands.max(1)))
    return f"The rest is strongest in {CHANNELS[worst].replace('_', ' ')} and follows no variable of the log."


def _nuisances(evidence: Evidence, fit: SetFit) -> dict[str, str]:
    """What the nuisances took, as text, from the first track of each flight."""
    numbers = [" ".join(key[:2]) for key in evidence.replay.numbers]
    names = (
        *numbers,
        "motor clock",
        "frame tilt x",
        "frame tilt y",
        "accelerometer bias x",
        "accelerometer bias y",
        "accelerometer bias z",
        "IMU tilt x",
        "IMU tilt y",
        "IMU tilt z",
        "gyroscopic torque x",
        "gyroscopic torque y",
        "gyroscopic torque z",
        "roll and pitch damping",
        "yaw damping",
        "pose clock",
    )
    taken = []
    for number, column in enumerate(fit.columns):
        n = evidence.replay.whitened_nuisances[number].reshape(len(evidence.replay.nuisances[number]), -1)
        w = evidence.replay.whiten(column[0], number).ravel()
        taken.append(np.linalg.solve(np.eye(len(n)) + n @ n.T, n @ w))
    size = min(len(t) for t in taken)
    mean = np.mean([t[:size] for t in taken], 0)
    return {name: f"{value:+.2f} of its usual size" for name, value in zip(names, mean, strict=False)}


__all__ = ["Library", "conclude", "diagnose", "diagnose_case", "library"]
