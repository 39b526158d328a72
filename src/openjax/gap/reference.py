"""Flights of the same vehicle while nothing was wrong with it: what the vehicle is
like, and what of a case is a change since then.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.gap.channels import Channel
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence, gather, with_identification
from openjax.gap.model.baseline import FORM, Baseline, day_of, transfer
from openjax.gap.model.cross_validation import Equations
from openjax.gap.model.hypotheses import SetFit, fit_set
from openjax.gap.model.library import ABSENT, CARDS, PLACE, THETA, Library, library, places
from openjax.gap.model.table import build, with_effects
from openjax.gap.residual import measure, residuals_of
from openjax.gap.selection import search_sets
from openjax.gap.trims import Change
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import VERY_RARE

ROUNDS = 3  # of the fit, between which nuisances are worked out anew
# What trims of a day look like, and so nothing that another day has as well.
OF_DAYS = tuple(e for e, card in CARDS.items() if card.trim is not None)
# Rare names of what a vehicle with nothing wrong has as well, as flapping of drag.
LASTING = tuple(e for e in FORM if e not in OF_DAYS)  # what no day moves
OTHER_NAMES = tuple(e for e in CARDS if CARDS[e].log_odds <= VERY_RARE and e not in FORM)


def read_reference(case: Case, progress=None) -> Baseline:
    """The vehicle's description from all flights of a reference case: the effects that a diagnosis
    would choose, of which those of the vehicle's form stay, and the numbers that every vehicle has.
    Raises UserError as `gather`.
    """
    effects = Library(tuple(e for e in library().effects if e not in (*OF_DAYS, *OTHER_NAMES)))
    evidence = gather(case, effects, progress, reference=True)
    search = search_sets(evidence)
    best = search.choose(np.ones((1, len(search.nothing.validation.nats))))[0].fit
    fit = fit_set(best.replay, best.effects, best.theta, rounds=ROUNDS)
    measures, _ = measure(evidence, residuals_of(fit))
    lasting = tuple(e for e in fit.effects if e in FORM)
    names, mean, covariance = _another_day(evidence, fit, lasting)
    theta = ABSENT.copy()
    for name, shift in zip(names, mean, strict=True):
        key = PLACE[tuple(name.split(" "))]
        # of an effect that the fit hasn't that is "absent"
        theta[key] = fit.theta[key] + shift
    channels = {c.path: c for c in evidence.channels}
    trim = _trim_of_a_day(fit, evidence.vehicles[0])
    # last, as what the vehicle is like is sought in the motion alone
    response = with_identification(evidence).identification
    return Baseline(theta, lasting, names, covariance, measures, channels, trim, response)


def borne_out(evidence: Evidence) -> Baseline:
    """The baseline of a case's evidence, with those of its effects that the case's
    flights don't speak against: what the vehicle has it has in both, and what only the
    reference's flights made it look like goes.
    """
    replay, baseline = evidence.replay, evidence.baseline
    subsets = [
        s for n in range(len(baseline.effects) + 1) for s in combinations(baseline.effects, n)
    ]
    thetas = np.array([with_some(baseline, s).theta for s in subsets])
    residuals = [
        y[None] - p for y, p in zip(replay.measurements, replay.predict(thetas), strict=True)
    ]
    squares = np.diag(replay.grams(residuals).sum(0))
    candidates = np.flatnonzero(squares <= (1.0 + DECISION.reference_loss) * squares.min())
    return with_some(
        baseline, subsets[max(candidates, key=lambda k: (len(subsets[k]), -squares[k]))]
    )


def with_some(baseline: Baseline, effects) -> Baseline:
    """A baseline with only these of its effects; the numbers that are no effect's
    stay.
    """
    removed_effects = set(baseline.effects) - set(effects)
    theta = baseline.theta.copy()
    theta[places(removed_effects)] = ABSENT[places(removed_effects)]
    rows = [k for k, n in enumerate(baseline.names) if n.split(" ")[0] not in removed_effects]
    names = tuple(baseline.names[k] for k in rows)
    covariance = baseline.covariance[np.ix_(rows, rows)]
    return replace(baseline, theta=theta, effects=effects, names=names, covariance=covariance)


def trim_of(theta: np.ndarray, effects, vehicle) -> np.ndarray:
    """(4,) by which share each rotor seems to push more than told, for those of the
    `effects` of theta (P,) that trims of a day look like.
    """
    out = np.zeros(4)
    for effect in (e for e in effects if e in OF_DAYS):
        values = {p.name: float(theta[PLACE[effect, p.name]]) for p in CARDS[effect].fitted}
        out += CARDS[effect].trim(values, vehicle)
    return out


def trimmed_before(
    theta: np.ndarray, effects, baseline: Baseline | None, vehicle, change: Change | None = None
) -> set[str]:
    """Those of the `effects` that are no change, though no day need have the trims of
    another one: what the comparison of all flights' trims (`change`) leaves to the
    spread of days; where logs allow none, trims that are more the reference's than not.
    """
    trims = set(effects) & set(OF_DAYS)
    if baseline is None or not trims:
        return set()
    if change is not None:
        return set() if change.trims_differ or change.trims_changed else trims
    trim = trim_of(theta, trims, vehicle)
    same = np.linalg.norm(trim - baseline.trim) < 0.5 * np.linalg.norm(trim)
    return trims if same else set()


def _trim_of_a_day(fit: SetFit, vehicle) -> np.ndarray:
    """(4,) the trim, as `trim_of`, that the nuisances of a reference's fit say."""
    table = build(fit, None)
    equations = Equations(table, with_effects(table))
    sizes = equations.solve(table.total)[2][len(fit.index) :]
    names = [n for n, s in zip(fit.replay.nuisance_names, fit.replay.is_shared, strict=True) if s]
    size_of = dict(zip(names, sizes.tolist(), strict=True))
    theta = ABSENT.copy()
    for e, p, size in fit.replay.numbers:
        if e in OF_DAYS:
            theta[PLACE[e, p]] += size * size_of[f"{e} {p}"]
    return trim_of(theta, OF_DAYS, vehicle)


def _another_day(evidence: Evidence, fit: SetFit, effects) -> tuple[tuple[str, ...], ...]:
    """Names, mean and covariance of the numbers of the `effects` (away from the fit, in
    their units) and of the other numbers of a vehicle that no day moves, as they are on
    another day. The other nuisances aren't transferred: what they take depends on what
    is flown, as in closed loop they also take what feedback makes of gusts.
    """
    table = build(fit, None)
    equations = Equations(table, with_effects(table))
    columns, model = equations.columns, equations.model
    inside = len(fit.index)
    sizes = {f"{e} {p}": size for e, p, size in fit.replay.numbers}
    shared_names = [
        n for n, s in zip(fit.replay.nuisance_names, fit.replay.is_shared, strict=True) if s
    ]
    names = [" ".join(THETA[i]) for i in fit.index]
    transfers = [n.split(" ")[0] in effects for n in names]
    transfers += [
        n in sizes and n not in names and _is_lasting(n, evidence.sensors.motor_clock)
        for n in shared_names
    ]
    names += shared_names
    unit = np.array([1.0] * inside + [sizes.get(n, 1.0) for n in shared_names])
    # Of the parameters themselves, whatever the columns' units.
    hessian = table.total[np.ix_(columns, columns)] / DECISION.dispersion
    precision = block_diag(model.precision, np.eye(len(columns) - inside))
    around = np.concatenate([model.mean, np.zeros(len(columns) - inside)])
    push = table.total[columns, 0] / DECISION.dispersion - hessian @ around
    days = np.ones(len(columns))
    for k in np.flatnonzero(transfers):
        effect, parameter = names[k].split(" ")
        day = day_of(effect, parameter, evidence.vehicles[0], evidence.charge_unknown)
        days[k] = day / unit[k]
    mean, covariance = transfer(hessian, push, precision, ~np.array(transfers), days)
    unit = unit[transfers]
    shifts = (mean + around[transfers]) * unit
    transferred_names = tuple(n for n, k in zip(names, transfers, strict=True) if k)
    return transferred_names, shifts, covariance * np.outer(unit, unit)


def _is_lasting(name: str, motor_clock: bool) -> bool:
    """True if a number ("effect parameter") is the vehicle's on any day. A lag that comes from
    motors on a clock of their own isn't.
    """
    effect, parameter = name.split(" ")
    is_time = EFFECTS[effect].parameters[parameter].unit == "s"
    return effect in LASTING and (motor_clock or not is_time)


def join(cases: Sequence[Case]) -> Case:
    """The flights of several folders of one vehicle as one case. Raises UserError where
    the vehicles differ.
    """
    first = cases[0]
    for case in cases[1:]:
        if case.vehicle_file.vehicle.mass != first.vehicle_file.vehicle.mass:
            raise UserError(
                f"{case.name}: its vehicle.toml has another mass than that of {first.name}; a "
                "reference is of one vehicle"
            )
    flights = [
        replace(f, name=f"{c.name}/{f.name}", log=f"{c.name}/{f.log}") if len(cases) > 1 else f
        for c in cases
        for f in c.flights
    ]
    quality = (issue for c in cases for issue in c.quality)
    return replace(first, flights=tuple(flights), quality=tuple(quality))


def differs(channel: Channel, effect: str, baseline: Baseline | None) -> bool:
    """True if a channel gives another size of an effect than the reference does: a parameter is
    further away than the errors of both, and than forms may be wrong by. A reference in which it
    doesn't act says the same only where it is nearer to the case than to nothing.
    """
    channel_before = baseline.channels.get(channel.path) if baseline is not None else None
    if channel_before is None:
        return True
    acts_there = effect in channel_before.acting()
    for parameter in CARDS[effect].fitted:
        estimate, estimate_before = (
            c.estimate(effect, parameter.name) for c in (channel, channel_before)
        )
        none = EFFECTS[effect].parameters[parameter.name].none
        apart = abs(estimate.value - estimate_before.value)
        error = np.hypot(
            max(estimate.below, estimate.above), max(estimate_before.below, estimate_before.above)
        )
        least = max(DECISION.standard_errors * error, DECISION.form_error * abs(estimate.value))
        if apart > least or (not acts_there and apart > abs(estimate_before.value - none)):
            return True
    return False
