"""The residual check: what stands out of cases without an unknown cause is told, and by
what.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from openjax.gap.decision import DECISION
from openjax.gap.model.whitening import Noise
from openjax.gap.residual import (
    HORIZONS,
    Check,
    _comparable,
    _larger,
    beyond,
    calibration,
    conformal_p,
    measure,
    standing_out,
)

ROWS = 1500
DT = 0.01


def left_over(push):
    """Measures of two tracks whose replay leaves white noise, and `push` (T,) in the
    first channel's increments.
    """
    rng = np.random.default_rng(0)
    tracks = [
        SimpleNamespace(
            dt=DT, time=DT * np.arange(ROWS), motor=0.6 + 0.05 * rng.standard_normal((ROWS, 4)), position=None,
            body_rates=rng.standard_normal((ROWS, 3)), velocity=None, quaternion=None, voltage=None, neighbours=(),
        )
        for _ in range(2)
    ]  # fmt: skip
    noises = [
        Noise(axes, np.ones(1), np.ones(1), 1.0)
        for axes in ((0, 1), (2,), (3, 4), (5,), (6, 7), (8,))
    ]
    replay = SimpleNamespace(
        tracks=tracks,
        usable=np.ones(9),
        noises=noises,
        whiten=lambda r, k: np.concatenate([n.whiten(r[:, n.axes]) for n in noises], 1),
    )
    residuals = [1e-3 * rng.standard_normal((ROWS, 9)) for _ in tracks]
    for residual in residuals:
        residual[:, 3] += np.cumsum(push) * DT
    motion = SimpleNamespace(gusts=None)
    made = SimpleNamespace(replay=replay, tracks=tracks, channels=(), motion=motion)
    measures, axes = measure(made, residuals)
    return measures, beyond(axes, {})


def test_a_push_is_left_in_its_channel_and_in_no_other():
    calm, small = left_over(np.zeros(ROWS))
    pushed, large = left_over(2.0 * np.sin(3.0 * DT * np.arange(ROWS)))
    assert pushed["velocity"] > 0.3 > 0.01 > calm["velocity"] and pushed["rates"] == calm["rates"]
    assert small.max() < 0.1 and large[3] > 0.5 and large[[0, 1, 2, 4, 5]].max() < 0.1


@pytest.mark.parametrize("name", HORIZONS)
def test_p_values_fall_with_each_measure_and_none_is_zero(name):
    usual = {n: float(np.median([c[n] for c in calibration() if n in c])) for n in HORIZONS}
    values = [conformal_p(usual | {name: usual[name] * k}) for k in (1.0, 10.0, 1e3)]
    p_values = [p for p, _ in values]
    assert (
        p_values[0] > 0.5
        and p_values == sorted(p_values, reverse=True)
        and 0.0 < p_values[-1] < 0.01
    )
    assert values[-1][1] == name


def test_a_case_of_the_calibration_stands_out_as_often_as_it_should():
    p_values = np.array([conformal_p(case)[0] for case in calibration()])
    assert (p_values <= 0.05).mean() <= 0.06
    assert standing_out(calibration()[0])[0] < 20.0


def test_a_log_with_nothing_to_hold_against_each_other_stands_out_nowhere():
    assert conformal_p({}) == (1.0, "")


def test_what_was_not_held_against_the_reference_is_rejected_as_without_one():
    """A battery that nobody logged leaves forces over, and isn't a change."""
    between = 0.5 * (DECISION.unknown + DECISION.unknown_with_reference)
    check = Check({}, "forces are left over", between, np.zeros(9), {})
    assert not check.rejects
    assert replace(check, by_reference=True).rejects


def test_sensors_that_disagree_leave_names_unless_forces_grew_as_well():
    reference = {"velocity": 0.02, "rates": 0.1, "position": 0.001}
    calm = {"velocity": 0.022, "rates": 0.09, "position": 0.01}
    assert _larger(calm, reference, "position") == []
    assert _larger(calm | {"velocity": 0.1}, reference, "position") == ["velocity"]
    assert _larger(calm, reference, "rates") == ["rates"]


@pytest.mark.parametrize(
    ("shift", "before", "kept"), [(0.0, 0.0, 3), (0.02, 0.0, 0), (0.0, 0.02, 1)]
)
def test_a_later_pose_jitters_and_isnt_compared(shift, before, kept):
    """Where only the reference's is late, its jitter is what is exceeded."""

    def channels(late):
        fit = SimpleNamespace(value=late)
        pose = SimpleNamespace(path="estimator", fit=fit, acting=lambda: {"late": 1.0})
        return {"estimator": pose}

    measures = dict.fromkeys(("estimator", "position", "accelerometer"), 0.1)
    baseline = SimpleNamespace(measures=measures, channels=channels(before))
    made = SimpleNamespace(
        baseline=baseline, charge_unknown=False, channels=tuple(channels(shift).values())
    )
    assert len(_comparable(made)) == kept
