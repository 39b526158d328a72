"""Which effects act: everything that the flights can show is tried in one model, and an effect stays only for what it
alone adds to predictions of stretches left out.

Forward, the effect that predicts most of what is left comes in; backward, what the others do as well goes; and each
that stays is set against every effect that could stand in its place."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit, fit_set, step_with
from openjax.gap.judging import Judged, judge, level
from openjax.gap.library import ABSENT, CARDS, places, prior, start_of
from openjax.gap.table import Table, build, with_effects

# The decision's numbers. None was learned from a plant.
LEAST_GAIN = 0.03  # floors by which an effect must shrink the gap on stretches left out
LEAST_NATS = 5.0  # by which it must raise their likelihood even without the second of flight that gains most:
# very strong evidence, in the usual words
LEAST_STEADY = 0.1  # of the nats must be left without that second: an effect that acts once isn't known
LEAST_SHARE = 0.01  # of the gap's rms above its floor: below, an effect is what the others' forms have wrong
TESTABLE = 6.0  # nats that an effect of usual size must leave in these flights,
EVIDENT = 20.0  # or that it explains as it is
MOST = 6  # effects at once
VERTICAL = 5  # of the errors: velocity z
OPENINGS = 3  # effects from which a search begins
LEFT_MUCH = 1.2  # of the squares that noise alone leaves: a search from several beginnings is worth its time
ROUNDS = 2  # of widening and swapping
ALIKE = 0.98  # correlation of two effects' parameters beyond which one of them is enough
CLASS = 10.0  # nats within which two effects do equally well
COMMONER = 20.0  # nats by which an effect must do better than a commoner one
TRIED = 2  # candidates of each kind fitted in full at each step


@dataclass(frozen=True)
class Gain:
    """What an effect adds on stretches left out, all others refitted: `nats`, and `steady` ones without the best second
    of flight, `floors` of the gap, `share` of its rms above what all together leave; `seen`: whether it does so in the
    channel where it must show."""

    nats: float
    steady: float
    floors: float
    share: float
    seen: bool = True

    @property
    def accepted(self) -> bool:
        often = self.steady > max(LEAST_NATS, LEAST_STEADY * self.nats)
        return often and self.floors > LEAST_GAIN and self.share > LEAST_SHARE and self.seen


@dataclass(frozen=True, eq=False)
class Selection:
    """`fit` of the accepted effects and of those that are feigned, the former in `effects`, strongest first; `table` around
    it; `gains` {effect: Gain} of the accepted, `offered` {effect: Gain} of the others beside them; `swaps` {effect: {other:
    nats that the other explains more in its place}}."""

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
    swaps: dict[str, dict[str, float]] = {}
    trail = _Trail()
    for _ in range(ROUNDS):
        fit, table, now = _widened(replay, fit, table, now, singles, trail)
        before = fit
        fit, table, now, swaps = _swapped(replay, fit, table, now, singles)
        if fit is before:
            break
        fit, table, now = _pruned(replay, fit, table, now, singles)
    gains = {e: gain_of(table, now, e) for e in fit.effects if e not in evidence.feigned}
    offered = {e: _offer(table, now, e) for e in table.step}
    return Selection(tuple(sorted(gains, key=lambda e: -gains[e].floors)), fit, table, gains, offered, swaps)


@dataclass(frozen=True)
class _Trail:
    """What a search has been through: sets that nothing widens (`whole`), and what came in beside a set and didn't stay
    (`dropped`)."""

    whole: set[frozenset] = field(default_factory=set)
    dropped: set[tuple[frozenset, str]] = field(default_factory=set)


def _widened(replay, fit, table, now, singles, trail: _Trail):
    """The set with everything that stays for what it adds. Pruning may take the search to a worse set than it came from: none
    that it left is come back to, or it would go round for ever."""
    behind: set[frozenset] = set()
    while len(fit.effects) < MOST and (base := frozenset(fit.effects)) not in trail.whole:
        left = {e: f for e, f in singles.items() if (base, e) not in trail.dropped}
        if fit.effects:
            ranked = [e for e in _ranked(table, singles, now) if e in left]
            tried = [_mended(replay, _joined(replay, fit, singles, e), singles, e) for e in ranked]
        else:
            tried = _openings(replay, fit, left)
        better = [f for f in tried if f is not None and f.score > fit.score + LEAST_NATS]
        for candidate in sorted(better, key=lambda f: -f.score):
            added = [e for e in candidate.effects if e not in fit.effects]
            if _stays(*_alone(replay, candidate), added):
                break
        else:
            trail.whole.add(base)
            break
        wider = build(replay, candidate, singles)
        pruned = _pruned(replay, candidate, wider, judge(wider, with_effects(wider)), singles)
        if frozenset(pruned[0].effects) in behind:
            trail.dropped.update((base, e) for e in added)
            continue
        fit, table, now = pruned
        trail.dropped.update((base, e) for e in candidate.effects if e not in fit.effects)
        if base != frozenset(fit.effects):
            behind.add(base)
    return fit, table, now


def _openings(replay, nothing: SetFit, singles) -> list[SetFit]:
    """What to begin with: the best effects alone and, where they leave much, the best with one more each, so that what
    two effects do together isn't given to a third that looks like both."""
    alone = sorted((f for f in singles.values() if is_itself(replay, f)), key=lambda f: -f.score)
    if not alone:
        return []
    best = alone[0].score - nothing.score
    first = [f for f in alone[:OPENINGS] if f.score - nothing.score > 0.5 * best]
    rows = sum(len(t) for t in replay.tracks) * replay.usable.sum()
    if alone[0].objective < LEFT_MUCH * 0.5 * rows:
        return alone[: TRIED + 1]
    pairs = {}
    for fit in first:
        table = build(replay, fit, singles)
        now = judge(table, with_effects(table))
        for effect in _ranked(table, singles, now):
            key = frozenset((*fit.effects, effect))
            if key not in pairs:
                pairs[key] = _joined(replay, fit, singles, effect)
    return [*alone[: TRIED + 1], *(f for f in pairs.values() if is_itself(replay, f))]


def testable(evidence: Evidence) -> dict[str, SetFit]:
    """{effect: its fit alone} of the physics effects that would show at their usual size. Where motor commands are duty
    cycles, what the unknown map to thrust can imitate isn't among them."""
    known = evidence.case.vehicle_file.motor_command != "pwm"
    return {
        k[0]: f
        for k, f in evidence.sets.items()
        if len(k) == 1
        and (known or not CARDS[k[0]].thrust_map)
        and isinstance(f, SetFit)
        and (evidence.exposure.get(k[0], 0.0) >= TESTABLE or f.score - evidence.nothing.score > EVIDENT)
    }


def _alone(replay, fit: SetFit) -> tuple[Table, Judged]:
    """The table of a set that nothing may widen, and the set judged."""
    table = build(replay, fit, {})
    return table, judge(table, with_effects(table))


def _stays(table: Table, whole: Judged, added) -> bool:
    """Whether one of the effects `added` to a set stays for what it adds."""
    return any(gain_of(table, whole, e).accepted for e in added)


def gain_of(table: Table, whole: Judged, effect: str) -> Gain:
    """What an effect of the table's set adds."""
    return _gain(table, effect, judge(table, with_effects(table, drop=(effect,))), whole)


def _offer(table: Table, now: Judged, effect: str) -> Gain:
    return _gain(table, effect, now, judge(table, with_effects(table, add=(effect,))))


@lru_cache(maxsize=1)
def _of_nothing(table: Table) -> Judged:
    """The table without any effect of its set."""
    return judge(table, with_effects(table, drop=table.fit.effects))


def _gain(table: Table, effect: str, without: Judged, whole: Judged) -> Gain:
    floor, nothing = floor_of(table, whole), _of_nothing(table)
    nats = whole.nats - without.nats
    less = level(without.squares, floor) - 1.0
    return Gain(
        float(nats.sum()),
        float(nats.sum() - max(nats.max(), 0.0)),
        less,
        less / max(level(nothing.squares, floor) - 1.0, 1e-9),
        not CARDS[effect].thrust_map or _lifts(table, without, whole),
    )


def _lifts(table: Table, without: Judged, whole: Judged) -> bool:
    """Whether an effect on the thrust shows where thrust does, along the vertical: torques alone are something else's."""
    if table.usable[VERTICAL] <= 0:
        return True
    before, after = (j.squares[:, VERTICAL].sum() for j in (without, whole))
    return bool(np.sqrt(before / max(after, 1e-30)) - 1.0 > LEAST_GAIN)


def floor_of(table: Table, whole: Judged) -> np.ndarray:
    """(6,) sums of squared errors that a model leaves, 0 where a channel wasn't logged."""
    return np.where(table.usable > 0, whole.squares.sum(0), 0.0)


def _ranked(table: Table, singles, now: Judged) -> list[str]:
    """Effects outside the table's set that promise most: by a straight line beside the set (nats, and nats of those that
    shrink the gap, too), and alone."""
    alone = sorted(table.step, key=lambda e: -singles[e].score)
    judged = {e: judge(table, with_effects(table, add=(e,))) for e in table.step}
    line = {e: (j.nats - now.nats).sum() for e, j in judged.items()}
    best = [e for e in sorted(line, key=lambda e: -line[e]) if line[e] > 0.0]
    wide = [e for e in best if level(now.squares, floor_of(table, judged[e])) - 1.0 > LEAST_GAIN]
    ranked = [*best[: TRIED + 1], *wide[:TRIED], *(e for e in alone[:TRIED] if line[e] > 0.0)]
    return list(dict.fromkeys(ranked))


def is_itself(replay, fit: SetFit) -> bool:
    """Whether no effect of a set is by its fitted value another one, and none of two that undo each other."""
    return not _entangled(fit) and not _others(replay, fit)


def _mended(replay, fit: SetFit, singles, newest: str) -> SetFit | None:
    """The set without what isn't itself beside its `newest` effect, and with what promises most once that is gone; None where
    it is the newest that isn't itself. What explained two causes at once makes way for them so."""
    gone: set[str] = set()
    while True:
        entangled = _entangled(fit)
        wrong = {*entangled, *_others(replay, fit)}
        if not wrong:
            break
        if entangled:
            wrong -= {newest}
        if newest in wrong:
            return None
        gone |= wrong
        fit = fit_set(replay, [e for e in fit.effects if e not in wrong], fit.theta)
    if not gone:
        return fit
    table = build(replay, fit, singles)
    ranked = [e for e in _ranked(table, singles, judge(table, with_effects(table))) if e not in gone]
    more = [f for f in (_joined(replay, fit, singles, e) for e in ranked[:TRIED]) if is_itself(replay, f)]
    best = max(more, key=lambda f: f.score, default=fit)
    return best if best.score > fit.score + LEAST_NATS else fit


def _others(replay, fit: SetFit) -> list[str]:
    """Effects of a set that are by their fitted values others."""
    tests = [e for e in fit.effects if CARDS[e].is_itself is not None]
    more = {o for e in tests for o in CARDS[e].beside if o not in fit.effects}
    alone, beside = fit.parameters(), step_with(replay, fit, more) if more else fit.parameters()
    wrong = []
    for effect in tests:
        found = beside if CARDS[effect].beside else alone
        named = {p: v for p, v in found[effect].items()}
        named |= {f"{o}.{p}": v for o in CARDS[effect].beside for p, v in found[o].items()}
        axes = list(CARDS[effect].torque_axes)
        named["gusts"] = (
            float(np.mean(replay.gusts[axes])) if axes and replay.gusts is not None else 0.0,
            0.0,
        )
        value, deviation = ({k: v[n] for k, v in named.items()} for n in (0, 1))
        if not CARDS[effect].is_itself(value, deviation):
            wrong.append(effect)
    return wrong


def _entangled(fit: SetFit) -> set[str]:
    """Effects of a set that can hardly be told apart in these flights: either would do."""
    deviation = np.sqrt(np.diag(fit.covariance))
    alike = np.abs(fit.covariance / np.outer(deviation, deviation))
    owner = np.array([next((e for e in fit.effects if i in places((e,))), "") for i in fit.index])
    apart = (owner[:, None] != owner[None]) & (owner[:, None] != "") & (owner[None] != "")
    return set(owner[(apart & (alike > ALIKE)).any(1)])


def _joined(replay, fit: SetFit, singles, effect: str, without: str | None = None) -> SetFit:
    """The set with one more effect (in another's place, if given), fitted from the best of a few starts: both as they
    were, the new one at its usual start, either alone."""
    rest = [e for e in fit.effects if e != without]
    if not rest:
        return singles[effect]
    base = fit.theta.copy()
    if without is not None:
        base[places((without,))] = ABSENT[places((without,))]
    own, starts = places((effect,)), []
    for values in (singles[effect].theta[own], start_of(effect), ABSENT[own]):
        starts.append(base.copy())
        starts[-1][own] = values
    starts.append(singles[effect].theta)
    starts = np.array(starts)
    order = [e for e in singles if e in (*rest, effect)]
    index, mean, precision = prior(order)
    left = [y[None] - p for y, p in zip(replay.measured, replay.predict(starts), strict=True)]
    off = starts[:, index] - mean
    objective = np.diag(replay.grams(left).sum(0)) + np.einsum("ki,ij,kj->k", off, precision, off)
    return fit_set(replay, order, starts[int(np.argmin(objective))])


def _pruned(replay, fit, table, now, singles):
    """The set without what the others do as well, and without what isn't itself once they are gone."""
    while fit.effects:
        gains = {e: gain_of(table, now, e) for e in fit.effects}
        others = _others(replay, fit)
        weakest = min(others or gains, key=lambda e: gains[e].floors)
        if gains[weakest].accepted and not others:
            break
        fit = fit_set(replay, [e for e in fit.effects if e != weakest], fit.theta)
        table = build(replay, fit, singles)
        now = judge(table, with_effects(table))
    return fit, table, now


def _same_gap(table: Table, one: Judged, other: Judged) -> bool:
    """Whether the first of two sets leaves no larger gap on stretches left out than the other; `table` of either."""
    return level(one.squares, floor_of(table, other)) - 1.0 < LEAST_GAIN


def _swapped(replay, fit, table, now, singles):
    """Each effect against every other in its place: the better one stays, and what comes near is told."""
    swaps: dict[str, dict[str, float]] = {}
    for effect in list(fit.effects):
        if effect not in fit.effects:  # made way for what came in another's place
            continue
        rest = [e for e in fit.effects if e != effect]
        lines = {}
        for other in table.step:
            more = judge(table, with_effects(table, add=(other,), drop=(effect,)))
            lines[other] = singles[other].score if not rest else float((more.nats - now.nats).sum())
        tried = {}
        alone = sorted(lines, key=lambda o: -singles[o].score)[:TRIED]
        for other in dict.fromkeys([*sorted(lines, key=lambda o: -lines[o])[:TRIED], *alone]):
            found = _mended(replay, _joined(replay, fit, singles, other, without=effect), singles, other)
            if found is not None:
                tried[other] = found
        gains = {o: f.score - fit.score for o, f in tried.items()}
        favoured = dict(gains)
        for other in CARDS[effect].commoner:
            if other not in gains:
                continue
            if gains[other] > -COMMONER or _same_gap(table, _alone(replay, tried[other])[1], now):
                favoured[other] = max(gains[other], 0.0) + COMMONER + LEAST_NATS
        for other in favoured:
            if effect in CARDS[other].commoner:
                favoured[other] -= COMMONER
        for best in sorted(favoured, key=lambda o: -favoured[o]):
            if favoured[best] <= LEAST_NATS:
                continue
            # What fits better without predicting more takes nobody's place, nor what is rarer and leaves the same gap.
            narrow, whole = _alone(replay, tried[best])
            same = effect in CARDS[best].commoner and _same_gap(narrow, now, whole)
            if same or not _stays(narrow, whole, [best]):
                del gains[best]
                continue
            ahead = gains.pop(best)
            swaps[best] = {o: v - ahead for o, v in (gains | {effect: 0.0}).items()}
            fit, table = tried[best], build(replay, tried[best], singles)
            now = judge(table, with_effects(table))
            break
        else:
            swaps[effect] = gains
    return fit, table, now, swaps
