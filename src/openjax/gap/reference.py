"""Flights of the same vehicle while nothing was wrong with it: what the vehicle is like, and what
of a case is a change since then.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.gap.channels import Channel
from openjax.gap.decision import DECISION
from openjax.gap.evidence import gather
from openjax.gap.model.baseline import FORM, Baseline, day_of, joint, moved
from openjax.gap.model.hypotheses import UNEXPOSED, fit_set
from openjax.gap.model.library import CARDS, library
from openjax.gap.model.table import build, with_effects
from openjax.gap.residual import measure, residuals_of

ROUNDS = 3  # of the fit, between which nuisances are worked out anew


def read_reference(case: Case, progress=None) -> Baseline:
    """What the vehicle is like, by all flights of a reference case. Raises UserError as `gather`."""
    evidence = gather(case, library(), progress, reference=True)
    exposure = evidence.motion.exposure
    shown = [e for e in FORM if exposure.get(e, 0.0) >= UNEXPOSED]
    fit = fit_set(evidence.replay, shown, rounds=ROUNDS)
    measures, _ = measure(evidence, residuals_of(fit))
    table = build(fit, None)
    names = [n for n, s in zip(fit.replay.nuisance_names, fit.replay.shared, strict=True) if s]
    day = partial(day_of, vehicle=evidence.vehicles[0], silent=evidence.charge_unknown)
    found, covariance, known = joint(table, with_effects(table), names, day)
    count = len(fit.index)
    mean = dict(zip(names, found[count:].tolist(), strict=True))
    return Baseline(
        moved(fit.theta, known, found[:count]),
        known,
        covariance,
        {n: v for n, v in mean.items() if n in known},
        measures,
        {c.path: c for c in evidence.channels},
    )


def joined(cases: Sequence[Case]) -> Case:
    """The flights of several folders of one vehicle as one case. Raises UserError where the
    vehicles differ.
    """
    first = cases[0]
    for case in cases[1:]:
        if case.vehicle_file.mass != first.vehicle_file.mass:
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
    """Whether a channel tells another size of an effect than the reference does: a parameter is
    further away than the errors of both, and than forms may be wrong by.
    """
    before = baseline.channels.get(channel.path) if baseline is not None else None
    if before is None:
        return True
    for parameter in CARDS[effect].fitted:
        here, there = (c.estimate(effect, parameter.name) for c in (channel, before))
        error = np.hypot(max(here.below, here.above), max(there.below, there.above))
        least = max(DECISION.standard_errors * error, DECISION.form_error * abs(here.value))
        if abs(here.value - there.value) > least:
            return True
    return False
