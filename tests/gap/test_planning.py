"""The next flight: what tells two causes apart is flown, and what no flight tells is
weighed.
"""

import json

import numpy as np
import pytest

from openjax.commands.plan import PlanCommand, make_plan
from openjax.errors import UserError
from openjax.flights.plans import plan_of, read_plan, write_plan
from openjax.flights.segments import LOWEST, SEGMENTS
from openjax.gap.model.library import ABSENT
from openjax.gap.planning.beliefs import beliefs_of, next_flight, sentence
from openjax.gap.planning.information import Advice, Belief, Promise, advise, of_pairs
from openjax.vehicle.arena import Arena
from openjax.vehicle.vehicle_file import load_vehicle_file


def between(*effects):
    """A report that can't tell these effects apart."""
    return {
        "effects": effects[:1],
        "probabilities": dict.fromkeys(effects, 0.95 / len(effects)) | {"none": 0.0},
        "equivalent": {effects[0]: list(effects[1:])},
        "parameters": {},
        "not_testable": [],
    }


def test_beliefs_are_probabilities_of_what_the_report_left_open():
    beliefs = beliefs_of(between("rotor_drag", "wind"))
    assert [b.name for b in beliefs] == ["nothing", "rotor_drag", "wind"]
    assert sum(b.probability for b in beliefs) == pytest.approx(1.0)


def test_an_effect_is_told_from_nothing_though_it_can_do_nothing():
    effects = ((), ("rotor_drag",), ("wind",))
    beliefs = [Belief(e, ABSENT, 1 / 3) for e in effects]
    speaks = np.zeros((1, 3, 3))
    speaks[0, 1, 0] = speaks[0, 2, 0] = 30.0  # what drag and wind do against nothing
    speaks[0, 1, 2] = 1.0  # wind holds a drag of its own
    speaks[0, 2, 1] = 20.0
    apart = of_pairs(speaks, beliefs)[0]
    assert apart[0, 1] == apart[1, 0] == 30.0
    assert apart[1, 2] == apart[2, 1] == 1.0


def test_no_flight_is_asked_for_where_hardly_anything_is_open():
    assert next_flight(between("rotor_drag"), load_vehicle_file()) == ""


def test_logs_that_hide_a_cause_are_mended_before_any_flight():
    promise = Promise("agile", 0.5, ("nothing", "motor_lag"), 20.0)
    advice = Advice((promise,), ("agile",), {promise.pair: 20.0})
    clocks = ["motors and gyroscope don't share a clock: motor commands are late"]
    report = between("rotor_drag") | {"sensors": clocks}
    assert "Before that, log motors and gyroscope" in sentence(advice, report)
    assert "Before" not in sentence(advice, between("rotor_drag"))


@pytest.mark.slow
def test_a_report_asks_for_the_flight_that_the_plan_puts_first(tmp_path):
    """They followed rules of their own once."""
    case = tmp_path / "case"
    case.mkdir()
    (case / "vehicle.toml").write_text('[vehicle]\nmass = 0.036\n[motor]\ncommand = "pwm"\n')
    vehicle = load_vehicle_file(case)
    report = between("rotor_drag", "wind") | {"vehicle": str(vehicle.path)}
    (case / "report.json").write_text(json.dumps(report))
    first = make_plan(PlanCommand(str(case), out=tmp_path / "plan"))[0]
    assert next_flight(report, vehicle) == first
    assert first.startswith("Fly")


@pytest.mark.slow
def test_passes_tell_ground_effect_and_a_scale_tells_mass():
    vehicle = load_vehicle_file()
    ground = advise(beliefs_of(between("ground_effect")), vehicle)
    assert ground.promises[0].segment == "low"
    assert "ground_effect" in ground.promises[0].pair
    report = between("mass", "thrust_scale")
    weighed = advise(beliefs_of(report), vehicle)
    assert "weigh the vehicle" in sentence(weighed, report)


def test_the_standard_plan_stays_in_the_box_for_two_minutes():
    plan = plan_of()
    assert len(plan) == 12_000
    assert set(plan.segment) == set(SEGMENTS)
    assert np.linalg.norm(plan.position[:, :2], axis=1).max() < Arena.radius - 0.1
    assert LOWEST <= plan.position[:, 2].min() < plan.position[:, 2].max() < Arena.height
    assert np.linalg.norm(plan.velocity, axis=1).max() < 2.0
    assert np.linalg.norm(plan.acceleration, axis=1).max() < 7.0


def test_a_plan_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "plan.csv"
    write_plan(path, plan_of(["hover"]))
    assert np.allclose(read_plan(path).position, plan_of(["hover"]).position, atol=1e-4)
    lines = path.read_text().splitlines()
    for broken in (lines[:1], [lines[0], lines[1].replace("0.6000", "nan")], ["t,x", "0,1"]):
        path.write_text("\n".join(broken))
        with pytest.raises(UserError, match=str(path)):
            read_plan(path)
