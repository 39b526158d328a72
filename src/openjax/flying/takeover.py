"""Landing by another process than the loop: wait where all are, land, disarm, say so.

The links' process and the guard do this for a loop that stops, and the loop for both of
these (`openjax.flying.board` says who flies).
"""

import time
from collections.abc import Callable

from openjax.flying.board import Board, Role, say
from openjax.flying.crtp import Supervisor
from openjax.flying.raw_links import RawLinks
from openjax.flying.safety import resting_places_of, step
from openjax.flying.set_point import SetPoint
from openjax.flying.state import FLYING, LANDING, Event, Mode, Request, State
from openjax.flying.swarm import Swarm

DISARMING = 1.0
"""A vehicle is asked to disarm until it says that it has, for so long (s)."""
TICK = 0.01
"""Of the landing (s)."""


def take_over(state: State, moment: float) -> State:
    """The state in which another process goes on flying from `moment` (s) on: all stop
    where they are, wait, and land.
    """

    def handed_over(drone, anchor):
        if drone.mode not in FLYING:
            return drone
        # who lands goes on landing, and who had just lifted off is nearest to the floor
        mode = Mode.LAND if drone.mode in (*LANDING, Mode.LIFT) else Mode.HOLD
        # the estimate is as good as what the one before knew
        drone = drone._replace(seen=moment)
        return drone.to(mode, moment, anchor, "another process took over")

    drones = tuple(map(handed_over, state.drones, resting_places_of(state)))
    return state._replace(drones=drones, time=moment, action_time=moment)


def fly_down(
    board: Board,
    role: Role,
    vehicles: Swarm | RawLinks,
    state: State,
    listen: Callable[[], None] = lambda: None,
) -> State:
    """Wait and land from what stands on the board, disarm; the last state.

    Args:
      board: of the session.
      role: whose process this is; it gives up should another one take over.
      vehicles: links.
      state: any of this flight, for its settings, pillars and airframe.
      listen: called at each tick; has the board say so if the operator wants all motors
      off.
    """
    board.pilot = role
    time_read = due = time.perf_counter()
    state = take_over(board.read(state, time_read), time_read)
    while state.flying and board.pilot is role:
        listen()
        request = Request.STOP if board.stopped else Request.NONE
        event = Event(time.perf_counter(), vehicles.observe(), request=request)
        state, set_points = step(state, event)
        vehicles.send(set_points)
        board.write(role, time.perf_counter(), state)
        # ticks that were missed aren't flown one after the other
        due = max(due + TICK, time.perf_counter() - TICK)
        time.sleep(max(due - time.perf_counter(), 0.0))
    if board.pilot is role:
        disarm(vehicles, board, role)
        board.write(role, time.perf_counter(), state)
        say("openjax fly: all vehicles are down and disarmed")
        time.sleep(3.0 * board.silence)
        for other in Role:  # what still hangs would only be in the way
            if other is not role and board.silent(other, time.perf_counter()) > 3.0 * board.silence:
                board.end_process(other)
    return state


def disarm(vehicles: Swarm | RawLinks, board: Board, role: Role) -> bool:
    """Ask all to disarm until they have, or nothing is heard of it; whether all have.
    `role`: whose process this is.
    """
    deadline = time.perf_counter() + DISARMING
    while True:
        board.beat(role, time.perf_counter())
        # motors off again and again: a packet may be lost
        vehicles.send([SetPoint()] * len(vehicles.observe()))
        vehicles.arm(False)
        time.sleep(0.03)
        # a vehicle that arms by itself always says that it is armed
        either = Supervisor.ARMED | Supervisor.AUTO_ARM
        any_armed = any(s.supervisor & either == Supervisor.ARMED for s in vehicles.observe())
        if not any_armed or time.perf_counter() > deadline:
            board.armed = any_armed
            return not any_armed
