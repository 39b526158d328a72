"""No sentence of a report contradicts another: reports of all kinds are read whole, and
each contradiction that a stranger found is told alone.
"""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.commands.sample_flights import SampleFlightsCommand, make_case
from openjax.gap.channels import Estimated
from openjax.gap.diagnosis import _runner_up
from openjax.gap.folders import diagnose_folder
from openjax.gap.intervals import _estimate
from openjax.gap.model.library import ABSENT, PLACE, forbidden
from openjax.gap.planning.beliefs import sentence
from openjax.gap.probabilities import agreeing
from openjax.gap.reference import trimmed_before
from openjax.gap.report import VERDICTS, Estimate, to_fly
from openjax.gap.report.page import next_steps, page_of
from openjax.gap.report.report import VERDICTS_SINCE
from openjax.gap.report.rules import broken_rules
from openjax.gap.shares import Gap
from openjax.gap.trims import change_between
from openjax.gap.where import without_nuisances
from openjax.vehicle.effects import EFFECTS
from tests.gap.made_reports import (
    CASE,
    OLD,
    VEHICLE,
    change,
    flights_of,
    identification,
    report,
)

NAMED = {
    "nothing": {},
    "drag": {"effects": ("rotor_drag",), "verdict": "effect", "before": 4.0},
    "lag": {"effects": ("motor_lag",), "verdict": "effect", "before": 2.0},
    "rotors": {"effects": ("motor_imbalance", "rotor_drag"), "verdict": "effect", "before": 3.0},
    "drag and more": {"effects": ("rotor_drag", "unknown"), "verdict": "effect", "before": 4.0},
    "unknown": {"effects": ("unknown",), "verdict": "unknown", "before": 3.0, "after": 3.0},
    "little seen": {"verdict": "not_testable"},
}
MEASURED = {
    "alike": identification(),
    "weaker": identification(ratio=0.86),
    "slow motors": identification(ratio=0.6, lag=0.049),
    "not trusted": identification(trusted=False),
}
SINCE = "Compared with the reference flights of the same vehicle."
TRIMS = {"alone": None, "a normal day": change(0.0), "a weak rotor": change(0.2)}
MADE = list(itertools.product(NAMED, MEASURED, TRIMS))


@pytest.mark.parametrize(("named", "measured", "trims"), MADE)
def test_every_sentence_agrees_with_every_other(named, measured, trims):
    """84 reports: whatever is named, measured and seen in trims."""
    made = report(**NAMED[named])
    reference = "" if TRIMS[trims] is None else SINCE
    parts = {"identification": MEASURED[measured], "trims": TRIMS[trims], "reference": reference}
    made = dataclasses.replace(made, **parts)
    assert broken_rules(made) == []
    advice = " ".join(why for why, _ in next_steps(made))
    agrees = made.headline() in (VERDICTS["none"], VERDICTS_SINCE["none"])
    assert ("Nothing needs correcting" in advice) == agrees == made.agrees
    assert ("fix it" in advice) == ("rotor 3" in made.headline())
    if measured != "slow motors":
        return  # a page takes longer to draw than to read
    page = page_of(made)
    assert page.count('class="sentence"') == 1
    # what is said elsewhere on the page is said by the same words
    for verdict in (*VERDICTS.values(), *VERDICTS_SINCE.values()):
        assert (verdict in page) == (verdict in made.headline())


def test_one_page_has_one_verdict_beside_a_reference():
    """A change within what days differ by isn't one, whichever part of the diagnosis
    saw it; and a change beyond that is one.
    """
    quiet, weak = change(0.0), change(0.2)
    assert not quiet.trims_changed and weak.trims_changed
    theta = ABSENT.copy()
    theta[PLACE["motor_imbalance", "m3"]] = -0.02
    known = SimpleNamespace(trim=np.zeros(4))
    names = ("motor_imbalance", "rotor_drag")
    assert trimmed_before(theta, names, known, VEHICLE, quiet) == {"motor_imbalance"}
    assert trimmed_before(theta, names, known, VEHICLE, weak) == set()
    # a centre of mass that moved has the pattern of no rotor, and is more than a day's
    offset = change_between("new", flights_of("new", (1.07, 0.97, 0.93, 1.03)), OLD, CASE)
    assert offset.trims_differ
    assert trimmed_before(theta, names, known, VEHICLE, offset) == set()
    calm = dataclasses.replace(report(), reference=SINCE, trims=quiet)
    assert calm.title == "no change" and "as in its reference" in calm.headline()
    assert not any("No change beyond" in line for line in calm.in_words())
    told = dataclasses.replace(report(), reference=SINCE, trims=weak)
    assert told.headline().startswith("The vehicle changed") and "motor_imbalance" in told.title
    assert told.to_dict()["verdict"] == "trims"
    # a battery that sags is why all rotors need more
    heavier = change(0.2, rotors=(0, 1, 2, 3))
    sag = report(("battery_sag",), "effect", before=9.0)
    sag = dataclasses.replace(sag, reference=SINCE, trims=heavier)
    assert heavier.changed and "trims" not in sag.headline() and broken_rules(sag) == []
    both = dataclasses.replace(report(**NAMED["drag"]), reference=SINCE, trims=weak)
    assert "The trims point to more" in both.headline()


@pytest.mark.parametrize(
    ("ratio", "error", "words"),
    [
        (0.86, 0.03, "turns with 0.86 [0.84, 0.88] of the simulator's acceleration"),
        (0.86, 0.3, "turns as the simulator does: gain × 0.86 [0.68, 1.09]"),
        (1.02, 0.005, "turns as the simulator does: gain × 1.02"),
    ],
)
def test_a_response_is_alike_where_its_band_says_so(ratio, error, words):
    assert words in identification(ratio, error).sentence()


def test_a_report_that_names_nothing_tells_of_numbers_that_differ():
    made = dataclasses.replace(report(), identification=identification(lag=0.049))
    assert "agrees" not in made.headline()
    assert (
        "time constant of speeding up 49 ms [44.3, 54.2], the simulator's 25 ms" in made.headline()
    )
    slightly = dataclasses.replace(report(), identification=identification(lag=0.028))
    assert "agrees" in slightly.headline() and "28" not in " ".join(slightly.in_words())
    # a cause is named, and the lag beside it is told as a measurement
    drag = dataclasses.replace(report(**NAMED["drag"]), identification=identification(lag=0.049))
    assert "Also measured, but not named" in " ".join(drag.in_words())


def test_an_interval_over_more_than_a_factor_of_ten_is_no_size():
    wide = Estimate(3.0, "1", (0.05, 20.0), (0.7, 1.6))
    assert "between 0.05 and 20, too uncertain for a size" in wide.in_words("zz")
    inertia = dataclasses.replace(report(), parameters={"inertia": {"zz": wide}})
    assert to_fly(inertia)[0]["inertia"]["zz"] == 1.0
    assert Estimate(3.0, "1", (1.0, 9.0), (0.7, 1.6)).is_size
    assert Estimate(0.1, "N", (-0.1, 0.3), (0.0, 1.0)).is_size


def test_what_may_be_usual_is_not_called_unusual():
    assert not Estimate(0.16, "1", (0.14, 0.18), (-0.15, 0.15)).unusual
    assert Estimate(0.18, "1", (0.16, 0.2), (-0.15, 0.15)).unusual


def test_an_interval_beyond_the_domain_has_a_width_and_begins_at_its_end():
    drag = EFFECTS["rotor_drag"].parameters["d_z"]
    low, high = _estimate(Estimated(-0.004, 0.001, 0.001), drag, VEHICLE).interval90
    assert low == 0.0 < high < 0.001
    assert _estimate(Estimated(0.004, 0.001, 0.001), drag, VEHICLE).interval90[0] > 0.002


def test_what_physics_forbids_is_not_named():
    theta = ABSENT.copy()
    theta[PLACE["battery_sag", "exponent"]] = -6.3
    theta[PLACE["rotor_drag", "d_xy"]] = 0.01
    theta[PLACE["rotor_drag", "d_z"]] = -0.001
    assert forbidden(theta, ("battery_sag", "rotor_drag"), VEHICLE) == {"battery_sag"}
    for axis in ("xx", "yy", "zz"):
        assert EFFECTS["inertia"].parameters[axis].limits()[1] < 68.9


def test_nothing_is_no_runner_up_of_a_gap_that_surely_closes():
    gap = Gap("rms", 50.0, 1.0, 1.0, 0.98, (0.97, 0.99))
    chance = {"mass": 0.5, "none": 0.4, "wind": 0.1}
    agreed = agreeing(chance, ("mass",), 0.4, gap.probability_of_none)
    assert sum(agreed.values()) == pytest.approx(1.0) and agreed["none"] < 0.05
    assert _runner_up(agreed, ("mass",), {}) == "wind"
    weak = Gap("rms", 1.05, 1.0, 1.0, 0.05, (0.0, 0.1))
    assert agreeing(chance, ("mass",), 0.4, weak.probability_of_none)["none"] > 0.2


def test_what_nuisances_explain_is_no_place_of_the_effect():
    """A drag's fit leaves a yaw torque to its nuisances; a fit without drag needs
    neither.
    """
    rows = np.ones(50)
    powers = {"force_x": [40.0 * rows, rows, rows], "torque_z": [14.0 * rows, rows, rows]}
    credited = without_nuisances(powers, {"force_x": 48.0 * rows, "torque_z": 1.1 * rows})
    assert credited["force_x"][0].mean() == 40.0 and credited["torque_z"][0].mean() < 1.2
    # an inertia that nuisances of each flight can take stays where it acts
    taken = without_nuisances(powers, {"force_x": 1.1 * rows, "torque_z": 1.1 * rows})
    assert taken["torque_z"][0].mean() == 14.0


def test_advice_is_said_without_units_of_evidence():
    promise = SimpleNamespace(segment="high", pair=("nothing", "thrust_saturation"), nats=167.0)
    words = sentence(SimpleNamespace(promises=[promise], nats={}), {})
    assert "tell whether thrust saturation acts" in words
    assert "nats" not in words and "nothing" not in words


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """Flights of another day, on which nothing was wrong."""
    folder = tmp_path_factory.mktemp("flights") / "before"
    make_case(SampleFlightsCommand(folder, seed=1))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("effect", ("none", *EFFECTS))
def test_reports_of_flights_with_every_effect_agree_with_themselves(tmp_path, before, effect):
    """What is generated, not made up: a report of each effect, alone and with another
    day's flights as the reference.
    """
    number = ("none", *EFFECTS).index(effect)
    make_case(SampleFlightsCommand(tmp_path / effect, effect=(effect,), seed=2 + number))
    # every fourth beside another day, too
    days = [(), (before,)]
    for reference in days[: 1 + (number % 4 == 0)]:
        assert broken_rules(diagnose_folder(tmp_path / effect, reference)) == []
