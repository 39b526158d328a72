"""The whole diagnosis of one case: evidence, selection, shares, words, report."""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import jax
import numpy as np

from openjax.background import one_blas_thread
from openjax.flights.flight import Case
from openjax.gap.criteria import DETECTABLE
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence, gather, with_identification
from openjax.gap.intervals import estimates, links
from openjax.gap.model.library import ABSENT, CARDS, PLACE, forbidden, library, path_of
from openjax.gap.planning.beliefs import beside_segments
from openjax.gap.probabilities import agreeing, probabilities
from openjax.gap.reference import OF_DAYS, borne_out, differs, join, read_reference, trimmed_before
from openjax.gap.report import Report
from openjax.gap.residual import Check, check_residual
from openjax.gap.selection import Selection, select
from openjax.gap.shares import Split, split
from openjax.gap.trims import Change
from openjax.gap.where import locate
from openjax.vehicle.effects import EFFECTS


@one_blas_thread
def diagnose_case(
    case: Case,
    without: Iterable[str] = (),
    progress=None,
    reference: Sequence[Case] = (),
    trims: Change | None = None,
) -> Report:
    """Diagnose the flights of a case.

    Args:
      case: see `openjax.gap.load_case`.
      without: effects that the library must do without.
      progress: called with a text as the work goes on.
      reference: flights of the same vehicle while nothing was wrong with it, a case for
      each day; told is then what changed since.
      trims: what the trims of all flights say changed, beside what days differ by.

    Raises:
      UserError: the flights are too short or hold no commands.
    """
    with jax.enable_x64(False):  # whatever the environment asks for
        return _diagnose(case, without, progress, reference, trims)


def _diagnose(case: Case, without, progress, reference, trims) -> Report:
    """`diagnose_case` in the precision that the fits are made for."""
    begin = time.perf_counter()
    baseline = read_reference(join(reference), progress) if reference else None
    evidence = gather(case, library(without), progress, baseline)
    if baseline is not None and (both := borne_out(evidence)).effects != baseline.effects:
        # what only the reference's flights looked like isn't this vehicle's nominal
        # state
        evidence = gather(case, library(without), progress, both)
    if progress:
        progress("identifying what the vehicle does")
    evidence = with_identification(evidence)
    if progress:
        progress("trying every effect that the flights can show")
    report = conclude(evidence, trims)
    return replace(report, seconds=time.perf_counter() - begin)


def conclude(evidence: Evidence, trims: Change | None = None) -> Report:
    """The report that the evidence supports, beside what `trims` say changed."""
    evidence, selection = agreed(evidence)
    effects = selection.effects
    theta = selection.fit.theta
    vehicle = evidence.vehicles[0]
    acting = {e: selection.probability(e) for e in effects}
    acting |= {
        e: p
        for channel in evidence.channels
        for e, p in channel.named_effects().items()
        if differs(channel, e, evidence.baseline)
    }
    of_days = trimmed_before(theta, effects, evidence.baseline, vehicle, trims)
    old = of_days | forbidden(theta, effects, vehicle)
    check = check_residual(evidence, selection.fit, selection.search.nothing.fit)
    if check.mostly_unknown:  # what acts is something else
        old |= set(effects) - selection.search.torque_effects
    candidates = [e for e, p in acting.items() if p >= DECISION.least_probability and e not in old]
    parts = worth_naming(
        lambda names: split(evidence, selection, check.excess, names),
        candidates,
        selection.search.torque_effects,
    )
    present = {e: acting[e] for e in parts.effects}
    rejects = (set(candidates) | old) - set(present)
    weights = Counter()
    for visited, weight in selection.weights.items():
        # a set with an effect that isn't worth a name stands for the rest of it
        weights[visited - rejects] += weight
    possible = evidence.library.effects
    chances = probabilities(present, parts.largest, check.probability, weights, possible)
    sure = max((share.interval90[0] for share in parts.effects.values()), default=0.0)
    no_gap = parts.gap.probability_of_none
    answers = words(check, parts)
    chances = agreeing(chances, answers or ("none",), sure, no_gap)
    causes = [e for e in answers if e in parts.effects]
    reference = _reference_in_words(evidence, causes, of_days, trims)
    report = _report(evidence, selection, check, parts, chances)
    return replace(report, reference=reference, identification=evidence.identification, trims=trims)


def agreed(evidence: Evidence) -> tuple[Evidence, Selection]:
    """The evidence with what the torques tell beside the thrust that the other effects
    leave, and the selection by it.
    """
    selection = select(evidence)
    if (torques := evidence.torques) is None:
        return evidence, selection
    beside = torques.with_thrust_of(selection.fit.theta, selection.effects)
    if beside.names == torques.names:
        return evidence, selection
    evidence = evidence.with_torques(beside)
    return evidence, select(evidence)


def worth_naming(
    shares_of: Callable[[list[str]], Split],
    effects: list[str],
    torque_effects: Collection[str] = (),
) -> Split:
    """The shares of those of the `effects` that have one, and that make held-out
    predictions better; `shares_of` splits the gap. Of the motion's effects it must be
    larger than errors of the others' forms, of the whole gap or of one channel's: rotors that
    differ turn the vehicle, and none of their errors is a wind's. What other estimators named
    (`torque_effects`) stays: a lag hides from predictions over a quarter of a second, and not
    from who trains a policy with it.
    """
    parts = shares_of(effects)
    while optional := [e for e in effects if e not in torque_effects]:
        dropouts = [
            e
            for e in optional
            if parts.reach(e) < least_share(e) or parts.effects[e].value < DECISION.least_share
        ]
        if not dropouts and parts.gap.reduction < DECISION.least_gap:
            dropouts = [min(optional, key=lambda e: parts.effects[e].value)]
        if not dropouts:
            break
        effects = [e for e in effects if e not in dropouts]
        parts = shares_of(effects)
    return parts


def least_share(effect: str) -> float:
    """Of the gap's square that an effect must take."""
    return DECISION.form_error if path_of(effect) == "physics" else DECISION.least_share


def words(check: Check, parts: Split) -> tuple[str, ...]:
    """The effects by share, and "unknown" among them where what is left isn't noise."""
    effects = sorted(parts.effects, key=lambda e: -parts.effects[e].value)
    if check.rejects:
        larger = sum(parts.effects[e].value > parts.unexplained.value for e in effects)
        effects.insert(larger, "unknown")
    return tuple(effects)


def not_testable(evidence: Evidence) -> list[str]:
    """Effects of the library that, at a usual size, these flights would not show."""
    motion = evidence.motion
    missing = [e for e in evidence.library.physics if motion.exposure[e] < DETECTABLE]
    # what is felt of a wake isn't the mean that the effect holds
    if motion.gusts is not None:
        missing += [e for e in evidence.library.physics if CARDS[e].of_others and e not in missing]
    missing += sorted(evidence.silent - set(missing))
    readable_paths = {c.path for c in evidence.channels} | {"physics"}
    missing += [e for e in evidence.library.effects if path_of(e) not in readable_paths]
    return missing + [e for c in evidence.channels for e in c.undetectable()]


def _report(
    evidence: Evidence, selection: Selection, check: Check, parts: Split, chances
) -> Report:
    """The report of a selection, checked and split into shares."""
    effects = words(check, parts)
    missing = [e for e in not_testable(evidence) if e not in effects]
    # that nothing is named says little where half of the library couldn't have shown
    nothing = "not_testable" if len(missing) >= len(evidence.library.effects) // 2 else "none"
    causes = [e for e in effects if e != "unknown"]
    equivalent = {e: selection.equivalent[e] for e in causes if e in selection.equivalent}
    second = _runner_up(chances, effects, equivalent)
    others = [o for e in causes for o in equivalent.get(e, ())]
    alone = not any(len(t.neighbours) for t in evidence.tracks)
    return Report(
        case=evidence.case.name,
        verdict=nothing if not effects else "unknown" if effects[0] == "unknown" else "effect",
        effects=effects,
        probabilities=chances,
        shares=parts,
        equivalent=equivalent,
        gap=parts.gap,
        not_testable=missing,
        quality=[
            {"flight": i.flight, "issue": i.issue, "left_out": i.refused}
            for i in evidence.case.quality
        ],
        runner_up=f"{second} ({chances[second]:.2f})" if second else "",
        rest=check.in_words(),
        sensors=tuple(evidence.sensors.findings.values()),
        contradictions=tuple(
            f"{i.flight}: {i.issue}" for i in evidence.case.quality if i.kind == "garbage"
        ),
        nuisances=_nuisances(evidence, selection),
        parameters=estimates(evidence, selection.fit, causes),
        links=links(evidence),
        where=locate(evidence, selection.fit, selection.search.nothing.fit, causes),
        to_show=beside_segments((*others, *missing, second), alone),
        residual={"p_value": check.p_value} | check.measures,
        residual_before=check.reference or {},
        plots={"evidence": evidence, "selection": selection},
    )


def _reference_in_words(
    evidence: Evidence, causes: Collection[str], of_days: Collection[str], trims: Change | None
) -> str:
    """The named effects' parameters in the reference flights, what may differ unseen between
    days, and what trims alone suggest (`of_days`).
    """
    text = ""
    if evidence.baseline is not None:
        values = [
            f"{e} {p} was {evidence.baseline.theta[PLACE[e, p]]:.3g} {_unit(e, p)}".strip()
            for e in causes
            for p in (f.name for f in CARDS[e].fitted)
            if (e, p) in PLACE
            and e not in OF_DAYS
            and evidence.baseline.theta[PLACE[e, p]] != ABSENT[PLACE[e, p]]
        ]
        text = "Compared with the reference flights of the same vehicle"
        text += f", in which {', '.join(values)}." if values else "."
        if evidence.charge_unknown:
            text += (
                " The battery's charge may differ between days, and with it the thrust of a duty "
                "cycle. Log vbat to compare thrust."
            )
    if trims is not None and of_days:
        names = " and ".join(sorted(of_days)).replace("_", " ")
        text += f" Trims differ in the way of {names}, but by no more than they do between days."
    elif trims is None and text and set(causes) & set(OF_DAYS):
        text += (
            " Trims move by 1 to 2.5 % of hover between days: so small a change may be the day's."
        )
    return text


def _unit(effect: str, parameter: str) -> str:
    """A parameter's unit; empty for a pure number."""
    unit = EFFECTS[effect].parameters[parameter].unit
    return "" if unit == "1" else unit


def _runner_up(chances, effects, equivalent) -> str:
    """The likeliest cause that is neither named nor would do as well; empty if hardly
    likely.
    """
    answers = {*(effects or ("none",)), *(o for others in equivalent.values() for o in others)}
    second = max((e for e in chances if e not in answers), key=chances.get, default="")
    return second if second and chances[second] > DECISION.least_rival else ""


def _nuisances(evidence: Evidence, selection: Selection) -> dict[str, str]:
    """The values that the vehicle's numbers and the sensors' mounting took, in usual sizes. A
    number at its bound says so.
    """
    names = np.array(evidence.replay.nuisance_names)[evidence.replay.is_shared]
    reference_names = () if evidence.baseline is None else evidence.baseline.names
    sizes = selection.hypothesis.validation.nuisance_sizes.mean(0)

    def at(v):
        return ", at its bound" if abs(v) > 0.99 * DECISION.nuisance_bound else ""

    entries = {
        n: f"{v:+.2f} of its usual size{at(v)}"
        for n, v in zip(names, sizes, strict=True)
        if n not in reference_names  # what the reference knows together has sizes of its own
    }
    if evidence.sensors.gain != 1.0:
        entries["gyroscope gain"] = f"{evidence.sensors.gain:.3f}"
    if "motor_rows" not in evidence.case.vehicle_file.log:
        entries["rows of motor commands"] = (
            "taken as means over the row, as vehicle.toml has no [log] motor_rows"
        )
    return entries
