"""The decision on hand-made scores, and the two paths that are read without physics."""

import dataclasses
import json

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.flights.track import Track
from openjax.gap import decision, estimator, firmware
from openjax.vehicle.effects import EFFECTS

ALL = set(EFFECTS)
PLAIN = decision.Settings(temperature=1.0, second_cost=8.0, second_share=0.01, testable=6.0)


def _paths(sets, **more):
    exposure = {e: 1000.0 for key in sets for e in key}
    return {"sets": {(): 0.0} | sets, "radio": None, "rate": None, "pose": None, "exposure": exposure} | more


def _best(paths, settings=PLAIN):
    return set(decision.decide_from(paths, ALL, None, settings).best)


@pytest.mark.parametrize("extra, named", [(60.0, {"thrust_curve"}), (200.0, {"thrust_curve", "wind"})])
def test_a_second_effect_must_add_more_than_an_inexact_form_leaves(extra, named):
    paths = _paths({("thrust_curve",): 8000.0, ("wind",): 5.0, ("thrust_curve", "wind"): 8000.0 + extra})
    assert _best(paths) == named


def test_the_share_is_the_strongest_effects_own():
    paths = _paths({("downwash",): 8000.0, ("inertia",): 2000.0, ("downwash", "inertia"): 8900.0})
    assert _best(paths) == {"downwash", "inertia"}
    assert _best(paths, dataclasses.replace(PLAIN, form_share={"downwash": 0.2})) == {"downwash"}


def test_an_effect_that_could_not_be_shown_competes_but_is_not_named():
    paths = _paths({("rotor_drag",): 60.0, ("motor_lag",): 40.0})
    assert _best(paths) == {"rotor_drag"}
    paths["exposure"]["rotor_drag"] = 1.0
    assert _best(paths) == set()


def test_air_that_hardly_moves_is_drag_not_wind():
    sets = {("wind",): 900.0, ("rotor_drag",): 890.0}
    assert _best(_paths(sets)) == {"wind"}
    assert _best(_paths(sets, calm=True)) == {"rotor_drag"}


def test_what_is_usual_on_nominal_flights_is_no_cause():
    paths = _paths({("thrust_saturation",): 14.0})
    assert _best(paths) == {"thrust_saturation"}
    assert _best(paths, dataclasses.replace(PLAIN, null_gain={"thrust_saturation": 10.0})) == set()


def test_strongest_is_what_the_set_would_miss_most():
    paths = _paths({("downwash",): 5000.0, ("inertia",): 10000.0, ("downwash", "inertia"): 16000.0})
    # Alone, the inertia takes what is the wake's; together, each has what the other can't give.
    assert decision.strengths_of(paths, ("downwash", "inertia")) == {"downwash": 6000.0, "inertia": 11000.0,
                                                                   "rate_gains": 0.0, "state_latency": 0.0}  # fmt: skip


def test_unknown_takes_its_share_from_all_others():
    paths = _paths({("mass",): 300.0})
    settings = dataclasses.replace(PLAIN, unknown={"sharp room": (1.0, 0.5, 2.0)}, unknown_bias=-1.0)
    quiet, loud = (decision.decide_from(paths, ALL, {"sharp room": v}, settings) for v in (0.0, 5.0))
    assert quiet.unknown < 0.01 and loud.unknown > 0.99
    assert sum(loud.probabilities.values()) == pytest.approx(1.0)


def test_settings_that_come_with_the_package_are_read_and_strange_ones_refused(tmp_path):
    settings = decision.load_settings()
    assert settings.unknown and settings.null.rest and 0.0 < settings.unknown_threshold < 1.0
    for table in ({"temprature": 2.0}, {"null": {"colums": {}}}):
        (tmp_path / "s.json").write_text(json.dumps(table))
        with pytest.raises(UserError, match="unknown"):
            decision.load_settings(tmp_path / "s.json")


@pytest.mark.parametrize(
    "theta, lost", [((-0.2, -0.6, -0.45), True), ((-0.4, -0.2, -0.3), False), ((0.5, 0.0, -0.6), False)]
)
def test_a_loop_that_saw_other_rates_is_not_a_loop_with_other_gains(theta, lost):
    assert (firmware.lost_share(theta) > 0.5) == lost


@pytest.mark.parametrize("delay", [0.0, 0.008, 0.06])
def test_a_late_pose_is_measured_however_late(delay):
    """Rotation about one axis: attitude from the closed form, `delay` s late."""
    time, rng = np.arange(900) * 0.01, np.random.default_rng(1)
    angle = lambda t: 0.4 * np.sin(9.0 * t) + 0.25 * np.sin(23.0 * t + 1.0)  # noqa: E731
    rate = 3.6 * np.cos(9.0 * time) + 5.75 * np.cos(23.0 * time + 1.0)
    half = 0.5 * (angle(time - delay) + 0.002 * rng.standard_normal(900))
    quaternion = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], 1)
    rates = np.stack([rate, 0 * rate, 0 * rate], 1) + 0.01 * rng.standard_normal((900, 3)) + [0.03, 0.0, 0.0]
    track = Track(
        name="a", flight="a", dt=0.01, time=time, position=None, quaternion=quaternion, velocity=None,
        body_rates=rates, specific_force=None, command=None, motor=None, voltage=None,
        neighbours=np.zeros((0, 900, 3)),
    )  # fmt: skip
    score, theta, covariance = estimator.read_estimator([track], np.array([0])).score()
    assert theta[0] == pytest.approx(delay, abs=0.001 + 2 * covariance[0, 0] ** 0.5)
    assert (score > 10.0) == (delay > 0.0)
