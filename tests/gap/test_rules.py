"""The rules that every report keeps: each is broken by what it forbids alone, and what
a diagnosis says is brought to keep them.
"""

import dataclasses
import functools

import numpy as np
import pytest

from openjax.gap.decision import DECISION
from openjax.gap.diagnosis import _runner_up, worth_naming
from openjax.gap.planning.beliefs import beside_segments
from openjax.gap.probabilities import agreeing, probabilities
from openjax.gap.report import Estimate, Report
from openjax.gap.report.rules import broken_rules
from openjax.gap.shares import Gap, Share, Split
from openjax.vehicle.effects import EFFECTS
from tests.gap.made_reports import identification

GAP = Gap("rms", 4.0, 1.2, 1.0, 0.7, (0.6, 0.8))


def split(shares, gap=GAP):
    found = {e: Share(*share) for e, share in shares.items()}
    rest = {"sensors": Share(0.1, (0.0, 0.2)), "unexplained": Share(0.0, (0.0, 0.1))}
    return Split(gap, found, **rest, largest=dict.fromkeys(found, 1.0))


GOOD = Report(
    case="tuesday", verdict="effect", effects=("inertia",), shares=split({"inertia": (0.8, (0.77, 0.82))}),
    probabilities={"inertia": 0.8, "none": 0.1, "unknown": 0.1}, equivalent={}, where=[], gap=GAP,
    parameters={"inertia": {"xx": Estimate(0.4, "1", (0.1, 0.7), (0.7, 1.6))}},
    not_testable=["downwash"], next_flight="", quality=[], runner_up="none (0.10)",
)  # fmt: skip


def inertia(low, value, high):
    return {"parameters": {"inertia": {"xx": Estimate(value, "1", (low, high), (0.7, 1.6))}}}


BROKEN = {
    "named and not testable": {"not_testable": ["downwash", "inertia"]},
    "named with a share of 0.000": {"shares": split({"inertia": (0.0, (0.0, 0.0))})},
    "predictions get worse": {"gap": dataclasses.replace(GAP, reduction=-0.01)},
    "inertia.xx = 0.33 [-0.31, 0.97] leaves": inertia(-0.31, 0.33, 0.97),
    "inertia.xx = 0.3 [0, 0.97] leaves": inertia(0.0, 0.3, 0.97),
    "inertia.xx = 0.9 [0.2, 0.7] leaves": inertia(0.2, 0.9, 0.7),
    "runner-up unknown (0.50) is likelier": {
        "probabilities": {"inertia": 0.4, "none": 0.1, "unknown": 0.5},
        "runner_up": "unknown (0.50)",
    },
    "none (0.32) beside a share of at least 0.77": {
        "probabilities": {"inertia": 0.68, "none": 0.32}
    },
}


def test_a_good_report_breaks_no_rule():
    assert broken_rules(GOOD) == []
    nothing = {"effects": (), "parameters": {}, "verdict": "none", "shares": split({})}
    said = {"probabilities": {"none": 0.9, "unknown": 0.1}, "runner_up": "unknown (0.10)"}
    said["gap"] = dataclasses.replace(GAP, before=1.0, after=1.0, reduction=0.0)
    assert broken_rules(dataclasses.replace(GOOD, **nothing, **said)) == []


@pytest.mark.parametrize("words", BROKEN)
def test_each_rule_is_told_alone(words):
    (broken,) = broken_rules(dataclasses.replace(GOOD, **BROKEN[words]))
    assert broken.startswith("tuesday: ") and words in broken


def test_torques_name_what_short_predictions_hardly_show():
    """Alone they must be trusted; beside a reference it is what changed since."""
    weak = {"shares": split({"inertia": (0.004, (0.003, 0.008))})}
    for trusted, reference, breaks in (
        (True, "", False), (False, "", True), (False, "Compared with", False),
    ):  # fmt: skip
        does = identification(trusted=trusted)
        report = dataclasses.replace(GOOD, identification=does, reference=reference, **weak)
        assert any("a share of 0.004" in words for words in broken_rules(report)) == breaks


@pytest.mark.parametrize("seed", range(40))
def test_probabilities_agree_with_what_is_named(seed):
    """Whatever draws of blocks chose, and however sure the unknown is."""
    rng = np.random.default_rng(seed)
    names = [str(e) for e in rng.permutation(list(EFFECTS))]
    present = {e: float(p) for e, p in zip(names[:2], rng.uniform(0.5, 1.0, 2), strict=True)}
    first, second, rest = (float(v) for v in rng.dirichlet([2.0, 1.0, 0.5]))
    largest = {names[0]: first, names[1]: second, "unexplained": rest}
    alone, pair, nothing, other = (float(v) for v in rng.dirichlet(np.ones(4)))
    weights = {frozenset(names[:1]): alone, frozenset(names[:2]): pair}
    weights |= {frozenset(): nothing, frozenset(names[3:4]): other}
    chance = probabilities(present, largest, float(rng.uniform()), weights)
    assert sum(chance.values()) == pytest.approx(1.0) and min(chance.values()) >= 0.0
    sure = float(rng.uniform())
    agreed = agreeing(chance, names[:2], sure)
    assert sum(agreed.values()) == pytest.approx(1.0) and min(agreed.values()) >= 0.0
    named = max(agreed[e] for e in names[:2])
    assert named >= max(p for e, p in agreed.items() if e not in names[:2]) - 1e-12
    assert sure < 0.5 or agreed["none"] <= 0.2 + 1e-12


def test_an_unknown_that_may_act_and_isnt_the_largest_is_no_reason_for_nothing():
    """The strongest is then what is named, whether or not something unknown acts as
    well.
    """
    chance = probabilities({"rotor_drag": 1.0}, {"rotor_drag": 1.0}, 0.6, {})
    assert chance["none"] > 0.2
    named = agreeing(chance, ["rotor_drag", "unknown"], 0.9)["rotor_drag"]
    # the most that may be said is how reliable choices are, less what nothing keeps
    assert named > 0.95 * DECISION.reliability * (1.0 - DECISION.none_beside)


def test_what_has_no_share_or_makes_predictions_worse_is_not_named():
    shares = {"mass": (0.7, (0.6, 0.8)), "inertia": (0.2, (0.1, 0.3)), "wind": (0.0, (0.0, 0.001))}

    def shares_of(named):
        worse = {"mass", "inertia"} <= set(named)
        gap = dataclasses.replace(GAP, reduction=-0.1 if worse else 0.5)
        return split({e: shares[e] for e in named}, gap)

    assert set(worth_naming(shares_of, list(shares)).effects) == {"mass"}
    assert set(worth_naming(shares_of, ["inertia"]).effects) == {"inertia"}
    assert worth_naming(shares_of, ["wind"]).effects == {}


def test_what_takes_a_part_of_one_channel_alone_is_named():
    shares = {"motor_imbalance": (0.98, (0.97, 0.99)), "wind": (0.016, (0.01, 0.02))}

    def shares_of(named, of_a_channel):
        parts = split({e: shares[e] for e in named}, GAP)
        return dataclasses.replace(parts, of_a_channel=of_a_channel)

    for part, named in ((0.9, {"motor_imbalance", "wind"}), (0.01, {"motor_imbalance"})):
        told = worth_naming(
            functools.partial(shares_of, of_a_channel={"wind": ("velocity x", part)}), list(shares)
        )
        assert set(told.effects) == named
    told = shares_of(
        list(shares), {"wind": ("velocity x", 0.9), "motor_imbalance": ("rates x", 1.0)}
    )
    assert told.of_one_channel("wind") == "0.90 of velocity x"
    assert told.of_one_channel("motor_imbalance") == ""


def test_nobody_who_logged_one_vehicle_is_sent_for_a_second():
    assert "the other" not in beside_segments(("downwash", "rate_gains", ""), alone=True)
    assert "rate gains" in beside_segments(("downwash", "rate_gains", ""), alone=True)
    assert "the other" in beside_segments(("downwash", "rate_gains", ""), alone=False)
    assert beside_segments(("downwash", "none"), alone=True) == ""


def test_the_runner_up_is_no_part_of_what_is_named():
    chances = {"rotor_drag": 0.5, "wind": 0.3, "none": 0.15, "mass": 0.05}
    assert _runner_up(chances, ("rotor_drag",), {"rotor_drag": ["wind"]}) == "none"
    assert _runner_up({"none": 0.995, "unknown": 0.005}, (), {}) == ""
