"""Rows of the judges' table, and how evaders escape."""

import numpy as np

from experiments.evaders.escapes import Moment, summary
from experiments.evaders.judged import page, rows_of, vehicle_of
from experiments.flying.vehicles import SLOWER
from openjax.commands.exploit_report import remark, verdict
from openjax.pursuit import PursuitSettings
from openjax.vehicle.effects import load_effects


def record(evader, scenario, steps):
    """Of episodes that end at these steps; 800 is none."""
    caught = [step < 800 for step in steps]
    rates = {"capture_rate": sum(caught) / len(steps), "crash_rate": 0.25}
    return {
        "evader": evader,
        "scenario": scenario,
        "episodes": len(steps),
        **rates,
        "capture_steps": steps,
    }


PLACES = ("wall", "narrow_gap", "random", "passage", "empty", "hidden", "uniform")
RECORDS = [
    record(evader, place, steps)
    for place in PLACES
    for evader, steps in (
        ("learned 0", [100, 200, 800, 800]),
        ("learned 1", [100, 100, 100, 800]),
        ("planner", [300, 800, 800, 800]),
        ("field", [50, 50, 50, 50]),
    )
]


def test_the_verdict_is_the_evader_that_is_caught_least():
    row = verdict(RECORDS)[0]
    assert (row["scenario"], row["evader"], row["capture_rate"]) == ("wall", "planner", 0.25)
    low, high = row["interval"]
    assert 0.0 < low < 0.25 < high < 1.0
    assert "wall (planner)" in remark(RECORDS)[0]
    assert not remark([r for r in RECORDS if r["evader"] != "planner"])


def test_a_slower_vehicle_has_rows_of_its_own():
    slower = {"records": RECORDS, "effects": load_effects(SLOWER)[1], "vehicle": "crazyflie"}
    assert vehicle_of(slower) == "slower" and vehicle_of({"records": RECORDS}) == "nominal"
    learned, *_ = rows_of("evaders", slower)
    assert learned["capture_rate"]["random"] == 0.5


def test_the_page_shows_a_short_and_the_whole_budget_of_weights_and_the_planner():
    learned, planner, _ = rows_of("evaders", {"records": RECORDS})
    slower = {**planner, "vehicle": "slower"}
    spent = [{**learned, "steps": million * 1e6} for million in (100, 500, 900)]
    curves = {"evaders, nominal": spent, "evaders, slower": spent, "tried: more, nominal": spent}
    told = page({"rows": [learned, planner, slower], "curves": curves}).parts.records
    assert [row["judge"] for row in told] == [
        "learners, 500 M steps",
        "learners, 900 M steps",
        "a planner",
    ]


def test_a_team_that_stands_round_the_evader_leaves_a_third_of_the_circle_open():
    """In the first second of the first of two episodes; then all fly beside each other above it,
    and the other episode ends with a capture.
    """
    angle = 0.3 + np.array([0.0, 2.0, 4.0]) * np.pi / 3
    around = np.stack([np.cos(angle), np.sin(angle), [-0.1, 0.0, 0.1]], axis=-1)
    beside = np.array([[1.0, 0.0, 0.5], [1.0, 0.1, 0.5], [1.0, -0.1, 0.6]])
    team = np.repeat(np.stack([around, beside]), 10, axis=0)[:, None]
    captured = np.zeros((20, 2), bool)
    captured[-1, 1] = True
    moments = Moment(
        pursuers=np.repeat(team, 2, axis=1),
        velocity=np.full((20, 2, 3, 3), [0.0, 0.6, 0.8]),
        evader=np.zeros((20, 2, 3)),
        in_sight=np.repeat(~captured[..., None], 3, axis=2),
        captured=captured,
    )
    found = summary(moments, PursuitSettings(), replan=10)
    assert (found["episodes"], found["captures"], found["speed"]) == (2, 1, [1.0, 1.0])
    assert found["open_angle"][0] == 120.0 and found["open_angle"][1] > 340.0
    assert found["all_above_or_below"] == [0.0, 1.0] and found["seen"] == [1.0, 1.0]
    np.testing.assert_allclose(found["spread_in_height"], [0.2, 0.1])
