"""A velocity that drifts gently, told by the teammates: against the study's sums, and
in a flight.
"""

import numpy as np
import pytest

from openjax.flying.drift import Drift, drifting
from openjax.flying.judge import Verdict
from tests.flying.fault_injection import observable
from tests.flying.test_safety import event, pursuing

USUAL = observable.VEHICLES["usual drag, attitude to .2 degrees"]


@pytest.fixture(scope="module")
def flights():
    """Unexplained accelerations and velocities (T, 4, 3, 2) of four teams, the first
    vehicles' estimates drifting by .5 m/s within 2 s, and when that began (s).
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observable, "FLIGHTS", 4)
        patch.setattr(observable, "SECONDS", 16.0)
        return observable.unexplained(np.random.default_rng(1), USUAL, (0.5, 2.0))


def team(flights, number):
    """The teammates' drifts at each row."""
    acceleration, velocity, _ = flights
    drifts = [Drift()] * 3
    for row in range(len(velocity)):
        both = zip(acceleration[row, number], velocity[row, number], drifts, strict=True)
        drifts = [d.update((*a, 0.0), (*v, 0.0), observable.PERIOD) for a, v, d in both]
        yield drifts


def test_sums_are_those_of_the_study(flights):
    acceleration, velocity, _ = flights
    sums = observable.summed(acceleration[:600], velocity[:600])[:, 2]
    flown = [
        [drift.size for drift in drifts] for drifts, _ in zip(team(flights, 2), sums, strict=False)
    ]
    # the study learns every tenth row only
    np.testing.assert_allclose(flown[50:], sums[50:], atol=0.03)


def test_only_the_one_that_drifts_is_told_and_not_a_lone_one(flights):
    told = {}
    for number in range(4):
        for row, drifts in enumerate(team(flights, number)):
            for vehicle in np.flatnonzero(drifting(drifts)):
                told.setdefault((number, int(vehicle)), row * observable.PERIOD)
            assert drifting(drifts[:1]) == (False,)
    assert told and {vehicle for _, vehicle in told} == {0}
    assert all(0.5 < when - flights[2][number] < 4.0 for (number, _), when in told.items())


def test_who_drifts_lands_with_the_team(flights):
    """By where its thrust has brought it; motion capture would have told it
    otherwise.
    """
    from openjax.flying.estimation import see

    state = pursuing()
    for row in range(5):
        state = see(state, 0.01 * row, event(0.01 * row + 1e-3).samples)
    assert state.drones[0].own.innovations.pose is not None
    usual = Drift(squares=1e-4, age=9.0)
    far = Drift(totals=(0.4, 0.0), squares=1e-4, age=9.0)
    drones = tuple(
        drone._replace(
            own=drone.own._replace(
                innovations=drone.own.innovations._replace(drift=far if i == 0 else usual)
            )
        )
        for i, drone in enumerate(state.drones)
    )
    state = see(state._replace(drones=drones), 0.05, event(0.051).samples)
    assert [drone.own.fault for drone in state.drones] == [Verdict.DRIFTS, "", ""]
    assert state.drones[0].estimate.velocity[0] == pytest.approx(-0.4, abs=0.02)
