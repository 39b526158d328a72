"""Faults at their source, flown in simulated time by the true vehicles: one of each kind, and motion capture that is late."""

import pytest

from experiments.flying.faults import FOLLOWED, KINDS
from experiments.flying.simulated import fly, well


@pytest.mark.slow
def test_nothing_that_goes_wrong_costs_a_vehicle():
    seeds = [kind for kind, name in enumerate(KINDS) if name != FOLLOWED]
    seeds.append(20172)  # late motion capture, which the estimator on board mustn't be told
    assert not [row for row in fly(seeds, "passage", "flight") if not well(row)]
