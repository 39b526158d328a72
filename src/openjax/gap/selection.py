"""The choice of physics effects that act: all small sets weighed by the model linearised, the best
of them fitted, then the most plausible set that isn't clearly worse.

The score of a set of effects is its log predictive density on stretches left out
(Vehtari, Gelman, Gabry 2017) plus the log prior odds of its effects. Only sets whose every
effect adds to it are fitted. Chosen is the set of the largest prior odds among those that
these flights can't tell from the best: the difference is within its standard errors, or the
gap grows by less than what matters (the one-standard-error rule of Breiman et al. 1984, with
a region of practical equivalence). How often each set is chosen when blocks of flight are
weighed anew by a Bayesian bootstrap is its probability; named is the most probable one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float

from openjax.background import side_by_side
from openjax.gap.criteria import (
    DETECTABLE,
    beyond_bounds,
    difference,
    log_odds,
    possible,
    practical,
    too_small,
    worse,
)
from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.cross_validation import (
    Validation,
    cross_validate,
    promise,
    promise_unbounded,
)
from openjax.gap.model.hypotheses import SetFit, fit_set, in_order
from openjax.gap.model.library import CARDS, places
from openjax.gap.model.table import Model, Table, build, with_effects
from openjax.gap.posterior import LARGEST

NOTHING = frozenset()
# Sets that are fitted in full, of those that the model promises as linearised around what
# other estimators named, and then around the best of these.
FITTED = 10
FITTED_AGAIN = 6
SCREENED = 4  # times as many are weighed with bounded nuisances before that
SIMPLER = 3  # of the best sets, those without one of their effects are fitted as well
DRAWS = 400  # of the bootstrap
ROUNDS = 10  # of the chosen set's last fit, between which nuisances are worked out anew


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A fitted set of effects, judged on stretches left out; `support`: nats by which
    gusts under other vehicles speak for it.
    """

    fit: SetFit
    validation: Validation
    log_odds: float
    support: float = 0.0

    @property
    def effects(self) -> tuple[str, ...]:
        return self.fit.effects

    @property
    def score(self) -> float:
        return float(self.validation.nats.sum()) + self.log_odds + self.support


@dataclass(frozen=True, eq=False)
class Selection:
    """A `hypothesis` and the `table` around it; `weights` {effects: share of the draws in
    which that set is chosen}; `equivalent` {effect: others that would do as well in its
    place}.
    """

    hypothesis: Hypothesis
    table: Table
    weights: dict[frozenset, float]
    equivalent: dict[str, list[str]]
    search: Search

    @property
    def fit(self) -> SetFit:
        return self.hypothesis.fit

    @property
    def effects(self) -> tuple[str, ...]:
        """Of the set, before they are found to be worth a name."""
        return self.fit.effects

    def probability(self, effect: str) -> float:
        """That the effect, or one that would do as well in its place, acts."""
        if effect in self.search.torque_effects:
            return self.search.evidence.torques.probability[effect]
        alike = {effect, *self.equivalent.get(effect, ())}
        return sum(w for effects, w in self.weights.items() if alike & effects)


def select(evidence: Evidence) -> Selection:
    """Choose among the physics effects that the flights can show."""
    search = search_sets(evidence)
    weights, best, fit = settle(search)
    best = replace(best, fit=fit)
    return Selection(best, build(fit, {}), weights, search.equivalents(best), search)


def settle(search: Search) -> tuple[dict[frozenset, float], Hypothesis, SetFit]:
    """The weights of the sets, the one that is chosen, and its fit once nuisances and
    parameters have settled. The search's fits end sooner: a set whose effects only then
    leave their physical bounds takes that fit, and the choice is made again.
    """
    while True:
        weights = search.weights()
        key = max(weights, key=weights.get)
        best = search.hypotheses[key]
        fit = fit_set(best.fit.replay, best.effects, best.fit.theta, rounds=ROUNDS)
        if possible(fit):
            return weights, best, fit
        search.hypotheses[key] = replace(best, fit=fit)


def search_sets(evidence: Evidence) -> Search:
    """The sets that were worth fitting."""
    search = Search(evidence, testable(evidence))
    search.enumerate(search.base, FITTED)
    search.enumerate(search.best, FITTED_AGAIN, search.beyond_bounds())
    search.fit_without_dropouts()
    return search


def testable(evidence: Evidence) -> dict[str, SetFit]:
    """{effect: its fit alone} of the physics effects that show, or would at their usual
    size.
    """
    motion = evidence.motion
    return {
        e: fit
        for e, fit in motion.singles.items()
        if max(motion.exposure[e], fit.score - motion.base.score) >= DETECTABLE
    }


def worth_fitting(score: dict[frozenset, float], base: frozenset) -> list[frozenset]:
    """Of sets that hold `base` those that promise more than it and than any part of them, the
    best first: an effect that adds nothing to the others is in no set that is chosen.
    """

    def gains(key: frozenset) -> bool:
        parts = [key - {effect} for effect in key - base]
        return all(score[key] > score.get(part, -np.inf) for part in (base, *parts))

    return [key for key in sorted(score, key=lambda key: -score[key]) if gains(key)]


@dataclass(eq=False)
class Search:
    """`singles` {effect: its fit alone} are those that may act; `hypotheses` {effects:
    hypothesis}.
    """

    evidence: Evidence
    singles: dict[str, SetFit]
    hypotheses: dict[frozenset, Hypothesis] = field(default_factory=dict)

    @cached_property
    def nothing(self) -> Hypothesis:
        return self.of_set(NOTHING, self.evidence.motion.nothing)

    @property
    def torque_effects(self) -> frozenset[str]:
        """The effects that other estimators named: part of every set."""
        return frozenset(self.evidence.replay.other_sizes)

    @cached_property
    def base(self) -> Hypothesis:
        """Of those alone."""
        return self.of_set(self.torque_effects, self.evidence.motion.base)

    @property
    def candidates(self) -> list[Hypothesis]:
        """The visited sets that hold them and stay within physical bounds."""
        with_these = (h for key, h in self.hypotheses.items() if self.torque_effects <= key)
        return [h for h in with_these if possible(h.fit)]

    def of_fit(self, fit: SetFit) -> Hypothesis:
        """The hypothesis of a fit."""
        table = build(fit, None)
        validation = cross_validate(table, with_effects(table))
        support = self.evidence.gust_nats(fit.theta)
        return Hypothesis(fit, validation, log_odds(fit.effects), support)

    def of_set(self, effects, near: SetFit) -> Hypothesis:
        """The hypothesis of a set, fitted from a neighbouring set's fit."""
        key = frozenset(effects)
        self.of_sets([key], near)
        return self.hypotheses[key]

    def of_sets(self, sets, near: SetFit) -> None:
        """`of_set` of several sets, side by side."""
        keys = dict.fromkeys(map(frozenset, sets))
        keys = [key for key in keys if key not in self.hypotheses]
        hypotheses = side_by_side(lambda key: self.of_fit(self._fit_near(key, near)), keys)
        self.hypotheses |= dict(zip(keys, hypotheses, strict=True))

    def _fit_near(self, key: frozenset, near: SetFit) -> SetFit:
        """The fit of a set, begun at a neighbouring set's."""
        if not key:
            return self.evidence.motion.nothing
        rest = key - self.torque_effects
        if key == self.torque_effects:
            return self.evidence.motion.base
        start = near.theta.copy()
        for new in rest - set(near.effects):  # as it was alone
            start[places((new,))] = self.singles[new].theta[places((new,))]
        return fit_set(near.replay, in_order(key), start)

    def beyond_bounds(self) -> frozenset:
        """Effects that leave their physical bounds in the visited set of the largest
        score.
        """
        return (
            beyond_bounds(max(self.hypotheses.values(), key=lambda h: h.score).fit)
            - self.torque_effects
        )

    def enumerate(self, near: Hypothesis, most: int, without: frozenset = NOTHING) -> None:
        """Fit and judge the most promising sets of up to LARGEST effects that weren't
        visited yet, by the model linearised around the hypothesis `near`, and what is
        left of each when one of its effects goes; sets with an effect of `without`
        aside.
        """
        table = build(near.fit, self.singles)
        models = {key: self._model(table, key) for key in self.sets() if not key & without}
        base = self.torque_effects

        def promises(keys, promise_of) -> dict[frozenset, float]:
            return {
                k: promise_of(table, models[k])
                - len(models[k].free)
                + log_odds(k)
                + self._gust_nats(k)
                for k in keys
            }

        candidates = worth_fitting(promises(models, promise_unbounded), base)[: SCREENED * most]
        best = worth_fitting(promises([base, *candidates], promise), base)
        next_sets = [key for key in best if key not in self.hypotheses][:most]
        next_sets += [
            key - {effect} for key in best[:SIMPLER] for effect in key - self.torque_effects
        ]
        self.of_sets(next_sets, near.fit)

    def fit_without_dropouts(self) -> None:
        """Fit what is left of the best sets when effects that may not be named go: ones
        too small to change a simulator for, or beyond their bounds.
        """
        best = sorted(self.hypotheses.values(), key=lambda h: -h.score)[:FITTED_AGAIN]
        for hypothesis in best:
            while dropouts := beyond_bounds(hypothesis.fit).union(too_small(hypothesis.fit)):
                left = set(hypothesis.effects) - dropouts | self.torque_effects
                if left == set(hypothesis.effects):
                    break
                hypothesis = self.of_set(left, hypothesis.fit)

    def _gust_nats(self, key: frozenset) -> float:
        """Nats by which gusts speak for a set with each effect as it was alone."""
        theta = self.base.fit.theta.copy()
        for effect in key - self.torque_effects:
            place = places((effect,))
            theta[place] = self.singles[effect].theta[place]
        return self.evidence.gust_nats(theta)

    def _model(self, table: Table, key: frozenset) -> Model:
        """A set in the table of another one."""
        present = set(table.fit.effects)
        come, leaving = (
            [e for e in CARDS if e in change] for change in (key - present, present - key)
        )
        return with_effects(table, come, leaving)

    def sets(self) -> list[frozenset]:
        """All sets of up to LARGEST effects that may act, with one at most that scales
        all motion.
        """
        sizes = range(LARGEST + 1)
        every = (self.torque_effects.union(s) for n in sizes for s in combinations(self.singles, n))
        return [s for s in every if sum("motion" in CARDS[e].scales for e in s) <= 1]

    @property
    def best(self) -> Hypothesis:
        """Of the visited sets that are possible the one of the largest score."""
        return max(self.candidates, key=lambda h: h.score)

    def tells_apart(self, best: Hypothesis, other: Hypothesis) -> bool:
        """True if flights tell a hypothesis from the best one, whether or not that matters for
        the gap: nuisances may take what another effect gets wrong.
        """
        gain, error, _ = difference(best.validation, other.validation)
        is_clear = gain > DECISION.standard_errors * error
        return is_clear or best.support - other.support > DETECTABLE

    def equivalents(self, hypothesis: Hypothesis) -> dict[str, list[str]]:
        """For each named effect those in whose place, of the sets visited, flights
        don't tell the difference: not a wind that doesn't blow, which is a drag.
        """

        def is_rival(hypothesis: Hypothesis) -> bool:
            return possible(hypothesis.fit) and practical(hypothesis.fit)

        torques = self.evidence.torques
        out = {} if torques is None else dict(torques.equivalent)
        for effect in set(hypothesis.effects) - self.torque_effects:
            rest = frozenset(hypothesis.effects) - {effect}
            alike = [
                next(iter(key - rest))
                for key, h in self.hypotheses.items()
                if len(key - rest) == 1 and rest < key and effect not in key
                and is_rival(h) and not self.tells_apart(hypothesis, h)
            ]  # fmt: skip
            if alike:
                out[effect] = sorted(alike)
        return out

    def choose(self, weights: Float[np.ndarray, "draws blocks"]) -> list[Hypothesis]:
        """For each row of blocks' weights (D, B) the hypothesis of the largest prior
        odds that isn't clearly worse than the best. Of equal odds it is the one with
        the most evidence: its density, worth as many nats as blocks bear out (Pauli,
        Racugno, Ventura 2011), less what its parameters cost (Occam's factor).
        """
        sets = [h for h in self.candidates if practical(h.fit)] or [self.base]
        odds, costs = np.array([(h.log_odds, h.fit.cost) for h in sets]).T
        pairs = [[difference(a.validation, b.validation) for b in sets] for a in sets]
        _, errors, trust = np.moveaxis(np.array(pairs), 2, 0)
        gusts = np.array([h.support for h in sets])
        # (D, sets)
        density = weights @ np.array([h.validation.nats for h in sets]).T + gusts
        squares = np.einsum("db,sbc->dsc", weights, np.array([h.validation.squares for h in sets]))
        choices = []
        for nats, gaps in zip(density, squares, strict=True):
            best = int(np.argmax(nats + odds))
            out = worse(nats[best] - nats, errors[best], gaps, gaps[best])
            # gusts judge by themselves: they count no blocks
            out |= gusts[best] - gusts > DETECTABLE
            usual = ~out & (odds == odds[~out].max())
            first = int(np.argmax(np.where(usual, nats, -np.inf)))
            evidence = trust[first] * (nats - nats[first]) - costs
            choices.append(sets[int(np.argmax(np.where(usual, evidence, -np.inf)))])
        return choices

    def weights(self) -> dict[frozenset, float]:
        """{effects: share of the draws in which that set is chosen}, of a Bayesian
        bootstrap over blocks (Rubin 1981).
        """
        blocks = len(self.nothing.validation.nats)
        draws = np.random.default_rng(0).dirichlet(np.ones(blocks), DRAWS) * blocks
        count = Counter(frozenset(h.effects) for h in self.choose(draws))
        return {effects: n / DRAWS for effects, n in count.items()}
