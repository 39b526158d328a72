"""Faults at their source, flown in simulated time by the true vehicles: one of each kind."""

import pytest

from experiments.flying.faults import BEYOND, KINDS
from experiments.flying.simulated import fly, well


@pytest.mark.slow
def test_nothing_that_goes_wrong_costs_a_vehicle():
    seeds = [kind for kind, name in enumerate(KINDS) if name not in BEYOND]
    assert not [row for row in fly(seeds, "passage", "flight") if not well(row)]
