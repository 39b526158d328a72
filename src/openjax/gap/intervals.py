"""Parameters of the named effects with their 90 % intervals.

An interval is the fit's, or what flights disagree by where that is more, and never
narrower than what forms that aren't quite the library's leave: some per cent of the
effect. What the torques' response tells is printed as the response has it, since the
replay's torques are biased where motors answer gusts.
"""

from collections.abc import Mapping

import numpy as np
from scipy.stats import truncnorm

from openjax.gap.channels import Estimated, of_flights
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.identification.quantities import REACH, Quantity
from openjax.gap.model.hypotheses import SetFit
from openjax.gap.model.library import CARDS, PLACE, path_of
from openjax.gap.report import Estimate
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import Parameter

TINY = 1e-9  # of an error that is none at all


def estimates(evidence: Evidence, fit: SetFit, effects) -> dict[str, dict[str, Estimate]]:
    """{effect: {parameter: its estimate}} of the named effects."""
    channels = {c.path: c for c in evidence.channels}
    of_torques = {
        (effect, p.name): (float(mean[k]), float(covariance[k, k]) ** 0.5)
        for effect, (mean, covariance) in evidence.replay.other_sizes.items()
        for k, p in enumerate(CARDS[effect].fitted)
        if not p.coupling
    }
    out = {}
    for effect in effects:
        channel = channels.get(path_of(effect))
        out[effect] = {}
        for entry in CARDS[effect].fitted:
            estimate = (
                channel.estimate(effect, entry.name)
                if channel
                else _of_physics(fit, effect, entry, of_torques)
            )
            parameter = EFFECTS[effect].parameters[entry.name]
            out[effect][entry.name] = _estimate(estimate, parameter, evidence.vehicles[0])
    return out


def links(evidence: Evidence) -> dict[str, Quantity]:
    """{"effect.parameter": number} of what pose, radio and rate loop tell, whether it
    is named or not.
    """
    out = {}
    for channel in evidence.channels:
        effects = set(evidence.library.of(channel.path)) - set(channel.undetectable())
        for effect in sorted(effects):
            for entry in CARDS[effect].fitted:
                parameter = EFFECTS[effect].parameters[entry.name]
                estimate = channel.estimate(effect, entry.name)
                number = _estimate(estimate, parameter, evidence.vehicles[0])
                out[f"{effect}.{entry.name}"] = Quantity(
                    number.value, number.interval90, parameter.none, number.unit, effect
                )
    return out


def _estimate(estimate: Estimated, parameter: Parameter, vehicle) -> Estimate:
    """A value with its 90 % interval, both as far as they lie where the parameter means
    anything.
    """
    start = estimate.value - REACH * estimate.below
    end = estimate.value + REACH * estimate.above
    least, most = parameter.limits(vehicle)
    value, low, high = np.clip((estimate.value, start, end), least, most).tolist()
    if low == high:
        # all of it lies beyond the domain: what a normal distribution has inside begins
        # at the bound and falls off
        error = max(estimate.below, estimate.above, TINY)
        ends = (np.array([least, most]) - estimate.value) / error
        inside = truncnorm(*ends, loc=estimate.value, scale=error).ppf([0.1, 0.9])
        low, high = (value, float(inside[1])) if value == least else (float(inside[0]), value)
    return Estimate(
        value=value,
        unit=parameter.unit,
        interval90=(low, high),
        usual=parameter.usual(vehicle),
        # before it is cut: an interval beyond the domain still holds what lies at its
        # edge
        may_be_none=bool(start <= parameter.none <= end),
    )


def _of_physics(fit: SetFit, effect: str, parameter, of_torques: Mapping) -> Estimated:
    """A parameter of the fit, or of the torques as they were measured. Forms may be
    wrong by a share of the effect's largest parameter of that unit.
    """
    parameters = EFFECTS[effect].parameters
    key = effect, parameter.name
    if key in of_torques:
        value, deviation = of_torques[key]
    else:
        covariance = of_flights(fit.covariance, fit.grams[:, 1:, 0])
        place = fit.index.tolist().index(PLACE[key])
        variance = max(covariance[place, place], fit.covariance[place, place])
        value = float(fit.theta[PLACE[key]])
        deviation = float(np.sqrt(variance))
    away = [
        abs(float(fit.theta[PLACE[effect, p.name]]) - parameters[p.name].none)
        for p in CARDS[effect].fitted
        if parameters[p.name].unit == parameters[parameter.name].unit
    ]
    error = float(np.linalg.norm((deviation, DECISION.form_error * max(away), parameter.error)))
    return Estimated(value, error, error)
