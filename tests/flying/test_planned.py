"""A plan is flown as a game is: by the same safety, along its path, from begin to
end.
"""

import numpy as np
import pytest

from openjax.flights.plans import plan_of
from openjax.flights.segments import SEGMENTS
from openjax.flying.controller import airframe_of
from openjax.flying.estimation import see
from openjax.flying.planned import PlannedFlight
from openjax.flying.safety import decide
from openjax.flying.set_point import from_action
from openjax.flying.state import Drone, Event, Mode, Request, SafetySettings, initial_state
from openjax.pursuit.environment import THRUST_LIMIT
from openjax.vehicle import load_vehicle
from openjax.virtual_crazyflie.vehicles import VirtualVehicles
from tests.flying.fault_injection.simulated import SimulatedSwarm


def flown(segments, effects=None):
    """Positions (T, 3) flown along segments in simulated time, the plan, and the last
    state.
    """
    vehicle = load_vehicle()
    plan = plan_of(segments)
    game = PlannedFlight(plan, airframe_of(vehicle))
    vehicles = VirtualVehicles(vehicle, plan.position[:1], effects)
    swarm = SimulatedSwarm(vehicles, [True], lambda i, t, p: p, lambda i, t, p: None)
    start = tuple(plan.position[0].tolist())
    # the simulated estimate is the truth, so nothing has to end a flight of two minutes
    state = initial_state([start], [], game.airframe, SafetySettings(alone_time=1e9))
    state = state._replace(drones=(Drone(Mode.PURSUIT),))
    positions = []
    play = None
    for _ in range(len(plan)):
        samples = swarm.observe()
        state = see(state, swarm.now, samples)
        poses = [d.estimate for d in state.drones]
        play = game.step(poses) if play else game.start(poses)
        actions = tuple(from_action(a, THRUST_LIMIT) for a in play.action)
        state, sent = decide(state, Event(swarm.now, samples, actions, Request.NONE, ""))
        swarm.send(sent)
        swarm.advance()
        positions.append(vehicles.report.position[0])
    return np.array(positions), plan, state, play


@pytest.mark.parametrize(
    "segments", [["low"], pytest.param(list(SEGMENTS), marks=pytest.mark.slow)], ids=len
)
def test_a_plan_is_flown_to_its_end_along_its_path(segments):
    positions, plan, state, play = flown(segments)
    assert state.drones[0].mode is Mode.PURSUIT, state.drones[0].reason
    assert play.over
    off = np.linalg.norm(positions - plan.position, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.15
    assert off.max() < 0.5
    assert positions[:, 2].min() > 0.08
