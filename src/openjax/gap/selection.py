"""Which effects act: everything that the flights can show is tried in one model, and an effect stays only for what it
alone adds to predictions of stretches left out.

Forward, the effect that predicts most of what is left comes in; backward, what the others do as well goes; and each
that stays is set against every effect that could stand in its place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit, fit_set
from openjax.gap.library import places
from openjax.gap.table import Judged, Table, build, judge, level, with_effects

# The decision's numbers. None was learned from a plant.
LEAST_GAIN = 0.02  # floors by which an effect must shrink the gap on stretches left out
LEAST_NATS = 5.0  # by which it must raise their likelihood even without the second of flight that gains most:
# very strong evidence, in the usual words
LEAST_SHARE = 0.01  # of the gap: below, an effect is what the others' forms have wrong
TESTABLE = 6.0  # nats that an effect of usual size must leave in these flights
MOST = 6  # effects at once
TRIED = 2  # candidates fitted in full at each step


@dataclass(frozen=True)
class Gain:
    """What an effect adds on stretches left out, all others refitted: `nats`, and `steady` ones without the best second
    of flight, `floors` of the gap, `share` of its power above what all together leave."""

    nats: float
    steady: float
    floors: float
    share: float

    @property
    def accepted(self) -> bool:
        return self.steady > LEAST_NATS and self.floors > LEAST_GAIN and self.share > LEAST_SHARE


@dataclass(frozen=True, eq=False)
class Selection:
    """`fit` of the accepted effects, strongest first in `effects`; `table` around it; `gains` {effect: Gain} of the
    accepted, `offered` {effect: Gain} of the others beside them; `swaps` {effect: {other: nats that the other explains
    more in its place}}."""

    effects: tuple[str, ...]
    fit: SetFit
    table: Table
    gains: dict[str, Gain]
    offered: dict[str, Gain]
    swaps: dict[str, dict[str, float]] = field(default_factory=dict)


def select(evidence: Evidence) -> Selection:
    """Choose among the physics effects that the flights can show."""
    replay, singles = evidence.replay, testable(evidence)
    fit = evidence.nothing
    table = build(replay, fit, singles)
    now = judge(table, with_effects(table))
    for _ in range(MOST):
        best = None
        for effect in _ranked(table, singles, now)[:TRIED]:
            tried = _joined(replay, fit, singles, effect)
            if best is None or tried.score > best.score:
                best = tried
        if best is None:
            break
        wider = build(replay, best, singles)
        whole = judge(wider, with_effects(wider))
        added = next(e for e in best.effects if e not in fit.effects)
        if not gain_of(wider, whole, added).accepted:
            break
        fit, table, now = best, wider, whole
        fit, table, now = _pruned(replay, fit, table, now, singles)
    fit, table, now, swaps = _swapped(replay, fit, table, now, singles)
    fit, table, now = _pruned(replay, fit, table, now, singles)
    gains = {e: gain_of(table, now, e) for e in fit.effects}
    offered = {e: _offer(table, now, e) for e in table.step}
    return Selection(tuple(sorted(gains, key=lambda e: -gains[e].floors)), fit, table, gains, offered, swaps)


def testable(evidence: Evidence) -> dict[str, SetFit]:
    """{effect: its fit alone} of the physics effects that would show at their usual size."""
    return {
        k[0]: f
        for k, f in evidence.sets.items()
        if len(k) == 1 and isinstance(f, SetFit) and evidence.exposure.get(k[0], 0.0) >= TESTABLE
    }


def gain_of(table: Table, whole: Judged, effect: str) -> Gain:
    """What an effect of the table's set adds."""
    without = judge(table, with_effects(table, drop=(effect,)))
    nothing = (
        judge(table, with_effects(table, drop=table.fit.effects)) if len(table.fit.effects) > 1 else without
    )
    return _gain(table, without, whole, nothing)


def _offer(table: Table, now: Judged, effect: str) -> Gain:
    more = judge(table, with_effects(table, add=(effect,)))
    nothing = judge(table, with_effects(table, drop=table.fit.effects))
    return _gain(table, now, more, nothing)


def _gain(table: Table, without: Judged, whole: Judged, nothing: Judged) -> Gain:
    floor = floor_of(table, whole)
    nats = whole.nats - without.nats
    power = lambda j: level(j.squares, floor) ** 2  # noqa: E731
    total = max(power(nothing) - 1.0, 1e-9)
    return Gain(
        float(nats.sum()),
        float(nats.sum() - max(nats.max(), 0.0)),
        level(without.squares, floor) - 1.0,
        (power(without) - 1.0) / total,
    )


def floor_of(table: Table, whole: Judged) -> np.ndarray:
    """(6,) sums of squared errors that a model leaves, 0 where a channel wasn't logged."""
    return np.where(table.usable > 0, whole.squares.sum(0), 0.0)


def _ranked(table: Table, singles, now: Judged) -> list[str]:
    """Effects outside the table's set that promise anything, best first."""
    found = {}
    for effect in table.step:
        more = judge(table, with_effects(table, add=(effect,)))
        # Alone, an effect's own fit is exact, and the table only a straight line to it.
        found[effect] = (more.nats - now.nats).sum()
        if not table.fit.effects:
            found[effect] = singles[effect].score
    if not table.fit.effects:
        return sorted(found, key=lambda e: -found[e])
    return sorted((e for e, v in found.items() if v > 0.0), key=lambda e: -found[e])


def _joined(replay, fit: SetFit, singles, effect: str) -> SetFit:
    """The set with one more effect, fitted from where both were."""
    if not fit.effects:
        return singles[effect]
    start = fit.theta.copy()
    start[places((effect,))] = singles[effect].theta[places((effect,))]
    order = [e for e in singles if e in (*fit.effects, effect)]
    return fit_set(replay, order, start)


def _pruned(replay, fit, table, now, singles):
    """The set without what the others do as well."""
    while len(fit.effects) > 1:
        gains = {e: gain_of(table, now, e) for e in fit.effects}
        weakest = min(gains, key=lambda e: gains[e].floors)
        if gains[weakest].accepted:
            break
        fit = fit_set(replay, [e for e in fit.effects if e != weakest], fit.theta)
        table = build(replay, fit, singles)
        now = judge(table, with_effects(table))
    return fit, table, now


def _swapped(replay, fit, table, now, singles):
    """Each effect against every other in its place: the better one stays, and what comes near is told."""
    swaps: dict[str, dict[str, float]] = {}
    for effect in list(fit.effects):
        rest = [e for e in fit.effects if e != effect]
        lines = {}
        for other in table.step:
            more = judge(table, with_effects(table, add=(other,), drop=(effect,)))
            lines[other] = singles[other].score if not rest else float((more.nats - now.nats).sum())
        tried = {}
        for other in sorted(lines, key=lambda o: -lines[o])[:TRIED]:
            start = fit.theta.copy()
            start[places((other,))] = singles[other].theta[places((other,))]
            order = [e for e in singles if e in (*rest, other)]
            tried[other] = singles[other] if not rest else fit_set(replay, order, start)
        gains = {o: f.score - fit.score for o, f in tried.items()}
        best = max(gains, key=gains.get, default=None)
        if best is not None and gains[best] > LEAST_NATS:
            gains[effect] = 0.0
            fit, level_ = tried[best], gains.pop(best)
            swaps[best] = {o: v - level_ for o, v in gains.items()}
            table = build(replay, fit, singles)
            now = judge(table, with_effects(table))
        else:
            swaps[effect] = gains
    return fit, table, now, swaps
