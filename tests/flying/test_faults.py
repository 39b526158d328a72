"""Faults at their source, flown in simulated time by the true vehicles: one of each
kind; vehicles of another weight.
"""

import json
import math

import pytest

from openjax.flying.safety import step
from openjax.flying.state import Event, Mode, Request, initial_state
from openjax.vehicle import load_vehicle
from openjax.virtual_crazyflie.vehicles import VirtualVehicles
from tests.flying.fault_injection import estimates
from tests.flying.fault_injection.fault_worlds import fly
from tests.flying.fault_injection.faults import BEYOND, FALL, KINDS, finite, well
from tests.flying.fault_injection.simulated import SimulatedSwarm


@pytest.mark.slow
def test_nothing_that_goes_wrong_costs_a_vehicle():
    seeds = [kind for kind, name in enumerate(KINDS) if name not in BEYOND]
    assert not [row for row in fly(seeds, "passage", "flight") if not well(row)]


@pytest.mark.slow
def test_no_estimate_that_contradicts_what_is_known_costs_a_vehicle():
    rows = estimates.fly(estimates.TOLD, [7], "passage", "flight")
    assert not [row for row in rows if not estimates.well(row)]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.7, 1.0, 1.3])
def test_a_vehicle_of_another_weight_flies_or_is_stopped_before_it_could_fall(share):
    """From the floor, by an airframe of the nominal weight."""
    vehicle = load_vehicle()
    vehicles = VirtualVehicles(vehicle.replace(mass=share * vehicle.mass), [(0.4, 0.0)])
    swarm = SimulatedSwarm(vehicles, [False], lambda i, now, pose: pose, lambda *_: None)
    state = initial_state([(0.4, 0.0, 0.5)])
    highest = 0.0
    for tick in range(800):
        if state.all_in(Mode.STOPPED, Mode.LANDED):
            break
        request = {30: Request.TRANSFER, 500: Request.LAND}.get(tick, Request.NONE)
        state, set_points = step(state, Event(swarm.now, swarm.observe(), None, request))
        swarm.send(set_points)
        swarm.advance()
        highest = max(highest, vehicles.report.position[0, 2])
    stopped = state.modes == (Mode.STOPPED,)
    assert stopped == (share != 1.0) and (highest < FALL if stopped else highest > 0.4)


def test_what_is_infinite_is_written_as_null_and_named():
    row = {
        "kind": "camera drifts",
        "duration": math.inf,
        "out": math.nan,
        "time": 1.5,
        "seconds": None,
    }
    read = json.loads(json.dumps(finite(row), allow_nan=False))
    assert read == {
        **row,
        "duration": None,
        "out": None,
        "not_finite": {"duration": "inf", "out": "nan"},
    }
