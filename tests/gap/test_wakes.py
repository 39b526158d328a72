"""What shakes under another vehicle is told from what shakes everywhere."""

from dataclasses import replace

import numpy as np
import pytest

from openjax.flights.track import Track
from openjax.gap.decision import DECISION
from openjax.gap.model.wakes import ASIDE, LINGERS, louder_in, under_another

DT = 0.01
ROWS = 1000


def passed(start: float) -> Track:
    """A vehicle that hovers while another one passes four times 40 cm above it, from
    `start` s on.
    """
    time = np.arange(ROWS) * DT
    other = np.stack([0.8 * np.cos(0.4 * np.pi * (time + start)), 0 * time, 0 * time + 0.8], 1)
    fields = dict.fromkeys(("quaternion", "velocity", "specific_force", "command", "motor"))
    return Track(
        name="pass",
        flight="pass",
        dt=DT,
        time=time,
        position=np.tile([0.1, 0.0, 0.4], (ROWS, 1)),
        body_rates=np.zeros((ROWS, 3)),
        voltage=None,
        neighbours=other[None],
        **fields,
    )


@pytest.mark.parametrize("strength", [1.0, 2.0])
def test_only_gusts_that_are_louder_under_another_vehicle_are_found(strength):
    rng = np.random.default_rng(3)
    tracks = [passed(0.0), passed(1.0)]
    rows = [under_another(track) for track in tracks]
    left = []
    for chosen in rows:
        # seconds differ in how loud they are, as those of hover and of turns do
        loud = np.repeat(rng.uniform(0.7, 1.4, ROWS // 100), 100) * np.where(chosen, strength, 1.0)
        left.append((loud[:, None] * rng.standard_normal((ROWS, 2)))[20:])
    ratio, errors = louder_in(tracks, rows, left)
    is_louder = errors > DECISION.clear_errors and ratio > DECISION.wake_loudness
    assert is_louder == (strength > 1.0)
    assert ratio == pytest.approx(strength**2, rel=0.3)


def test_a_wake_is_felt_until_it_has_passed():
    track = passed(0.0)
    chosen = under_another(track)
    gap = track.neighbours[0] - track.position
    near = np.hypot(gap[:, 0], gap[:, 1]) < ASIDE
    late = round(LINGERS / DT)
    expected = near | np.array([near[max(k - late, 0) : k + 1].any() for k in range(ROWS)])
    np.testing.assert_array_equal(chosen, expected)
    below = replace(track, neighbours=track.neighbours - [0.0, 0.0, 0.8])
    assert not under_another(below).any()
