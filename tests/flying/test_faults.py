"""Faults at their source, flown in simulated time by the true vehicles: one of each kind, and motion capture that is late."""

import pytest

from experiments.flying.faults import FOLLOWED, KINDS
from experiments.flying.simulated import fly, well

LATE = KINDS.index("camera late")


@pytest.mark.slow
def test_nothing_that_goes_wrong_costs_a_vehicle():
    seeds = [kind for kind, name in enumerate(KINDS) if name != FOLLOWED]
    # without the age that the gyroscope tells, these four end hard or outside
    seeds += [LATE + len(KINDS) * k for k in (2, 14, 26, 47)]
    assert not [row for row in fly(seeds, "passage", "flight") if not well(row)]
