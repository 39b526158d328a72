"""The exam's scorer against hand counts."""

import json

import numpy as np
import pytest

from experiments.diagnosis import (
    answer_key,
    judge,
    magnitudes,
    score,
)


def test_names_that_logs_cannot_tell_apart_are_right_and_no_others():
    seen, blind = np.full(12, 3.0), np.full(12, 3.0)
    blind[3:6] = 0.1  # no torque shows
    assert answer_key.accepted("inertia", False, seen) == ["inertia"]
    assert answer_key.accepted("blade_flapping", False, seen) == ["blade_flapping"]
    assert "rotor_drag" in answer_key.accepted("blade_flapping", False, blind)
    assert answer_key.accepted("motor_imbalance", True, seen) == ["motor_imbalance"]
    assert "com_offset" in answer_key.accepted("motor_imbalance", True, blind)
    assert answer_key.accepted("battery_sag", True, seen, scale=True) == ["battery_sag", "thrust_scale"]
    assert set(answer_key.accepted("battery_sag", False, seen, scale=True)) == {
        "battery_sag",
        "thrust_scale",
        "mass",
    }
    held = answer("none") | {"held_ms": 20.0}
    for late, right in ((0.012, True), (0.040, False)):
        report = said("state_latency", parameters={"state_latency": {"delay": {"value": late}}})
        assert judge.judge(held, report)["right"] == right
        assert not judge.judge(answer("none"), report)["right"]
    for hidden, right in (
        ("loose_propeller", True),
        ("inertia", False),
    ):  # too small to be asked for, and yet there
        assert judge.judge(answer("not_testable", hidden), said("unknown"))["right"] == right


def answer(category, effect=None, **more):
    out = {"category": category, "effects": [effect] if effect else []}
    out["expected"] = [effect if category == "single" else category]
    out |= {
        "acceptable": {},
        "also_fine": [],
        "causes": [],
        "severity": "medium",
        "severity_ratio": 3.0,
        "shares": {},
    }
    out |= {
        "gap": {"before": 2.0, "floor": 1.0, "closed_by_truth": 0.5},
        "controller": "geometric",
        "told": {},
    }
    sensed = {"kind": "white", "rate": 100, "turbulence": "none", "channels": "pgacmv"}
    if effect and category == "single":
        out["causes"] = [{"effect": effect, "form": "x", "size": 0.1, "magnitudes": {}}]
    return out | {"sensors": sensed, "missions": [["laps"]]} | more


def said(*names, verdict="effect", **report):
    facts = {"seconds": 1.0, "status": 0, "first": False, "error": "", "traceback": None}
    return facts | {"report": {"verdict": verdict, "effects": list(names)} | report}


def test_the_scorer_counts_right():
    refused = said() | {"report": None, "status": 2, "error": "error: no"}
    broken = said() | {"report": None, "traceback": "Traceback"}
    drag = answer("single", "rotor_drag", shares={"rotor_drag": 0.8})
    mass = answer("single", "mass", acceptable={"mass": ["mass", "thrust_scale"]})
    two = answer("pair", "wind", effects=["wind", "inertia"], expected=["wind", "inertia"])
    rows = {
        "right": (
            drag,
            said(
                "rotor_drag",
                shares={"effects": {"rotor_drag": {"value": 0.45}}, "sensors": {"value": 0.1}},
                gap={"before": 2.0, "reduction": 0.4},
            ),
        ),
        "class": (mass, said("thrust_scale")),
        "second": (drag, said("wind", "rotor_drag")),
        "extra": (drag, said("rotor_drag", "inertia")),
        "rest": (drag, said("rotor_drag", "unknown")),
        "none_right": (answer("none"), said(verdict="none")),
        "none_wrong": (answer("none"), said("mass")),
        "none_unknown": (answer("none"), said(verdict="unknown")),
        "unknown_right": (answer("unknown", "slung_load", also_fine=["mass"]), said("mass", "unknown")),
        "unknown_wrong": (answer("unknown", "draught"), said("inertia")),
        "garbage_named": (answer("garbage", "motor_order"), said(verdict="contradictory")),
        "garbage_refused": (answer("garbage", "motor_order"), refused),
        "garbage_missed": (answer("garbage", "motor_order"), said("rotor_drag")),
        "pair": (two, said("inertia", "wind")),
        "pair_half": (two, said("inertia")),
        "broken": (drag, broken),
        "lost": (drag, refused),
    }
    answers = {k: a for k, (a, _) in rows.items()}
    result = score.score(answers, {k: p for k, (_, p) in rows.items()})
    f = {k: v["value"] for k, v in result["figures"].items()}
    assert f["top1"] == pytest.approx(4 / 7)
    assert f["nothing_extra"] == pytest.approx(5 / 7)
    assert f["false_unknown"] == pytest.approx(1 / 9)
    assert f["none"] == pytest.approx(1 / 3)
    assert f["unknown_recall"] == 0.5
    assert f["unknown_wrong_name"] == 0.5
    assert f["garbage"] == pytest.approx(2 / 3)
    assert f["false_garbage"] == pytest.approx(1 / 14)
    assert f["pair_exact"] == 0.5
    assert f["pair_f1"] == pytest.approx((1 + 2 / 3) / 2)
    assert f["share_error"] == pytest.approx(0.8 - 0.45 / 0.9)
    assert f["traceback"] == pytest.approx(1 / 17)
    assert f["seconds"] == 1.0
    assert magnitudes.gap_said(*rows["right"]) == pytest.approx(0.8)
    assert "| single cause: first name right |" in score.markdown("x", result)
    assert len(score.misses(answers, result, {k: p for k, (_, p) in rows.items()})) == 9
    json.dumps(result)


def test_intervals_and_calibration():
    assert score.wilson(8, 10) == pytest.approx((0.490, 0.943), abs=1e-3)  # Wilson 1927, tabulated
    error, rows = score.calibration([(0.9, True)] * 8 + [(0.9, False)] * 2 + [(0.35, False)] * 10)
    assert error == pytest.approx(0.5 * 0.1 + 0.5 * 0.35)
    assert [r["n"] for r in rows] == [10, 10]
    fitted = {"scale": {"value": 0.09, "interval90": [0.06, 0.12]}}
    cause = {"effect": "thrust_scale", "form": "plain", "size": 0.1, "magnitudes": {"scale": 0.1}}
    case = answer("single", "thrust_scale") | {"causes": [cause]}
    (row,) = magnitudes.parameters(case, said("thrust_scale", parameters={"thrust_scale": fitted}))
    assert row["covered"] == [True]
    assert row["error"] == pytest.approx(0.1)
    assert row["half_widths"] == pytest.approx([0.3])
    assert magnitudes.before_thrust(case, said("thrust_scale", gap={"before": 4.0})) == 4.0
