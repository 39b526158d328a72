"""Checks of flight logs: what can be mended is mended and named, what can't be used is
refused with a reason.
"""

from openjax.flights.agreement import check_agreement
from openjax.flights.airborne import airborne_part, check_above_floor
from openjax.flights.attitude import derive_attitude
from openjax.flights.derived import derive_rates, derive_velocity, mend_velocity
from openjax.flights.flight import Flight, Issue, Refused
from openjax.flights.range_checks import in_range
from openjax.flights.sampling import drop_frozen, drop_held_rows, drop_repeats, put_in_step
from openjax.flights.time_checks import in_time, while_motors_turn


def check_flight(
    flight: Flight, vehicle, log: dict | None = None, comparison: bool = False
) -> tuple[Flight | None, list[Issue]]:
    """Check one flight as read. Returns it sorted, cleaned and cut to its airborne part, or None if
    it can't be used, and the findings. `vehicle` is the nominal vehicle, `log` the vehicle file's
    `[log]` table (floor_z). For a `comparison` of flights with flights the motor commands alone are
    enough, and every airborne stretch is kept, not only the longest.
    """
    issues: list[Issue] = []

    def note(kind: str, text: str) -> None:
        issues.append(Issue(flight.name, text, kind=kind))

    # in this order: time before what is cut by it, motors before sensors that stand
    # still with them, ranges before anything is derived from values that can't be
    try:
        _has_what_is_needed(flight, comparison)
        result = while_motors_turn(in_time(_with_forces(flight, note), note), note)
        result = drop_held_rows(result, note)
        result = put_in_step(drop_repeats(drop_frozen(result, note), note), note)
        result = in_range(result, note)
        result = derive_velocity(mend_velocity(result, note), note)
        result = derive_attitude(derive_rates(result, note), note)
        floor = (log or {}).get("floor_z")
        result = airborne_part(result, floor, note, comparison)
        check_above_floor(result, 0.0 if floor is None else float(floor))
        _has_what_is_needed(result, comparison)
    except Refused as refused:
        return None, [*issues, Issue(flight.name, str(refused), refused=True, kind=refused.kind)]
    disagreements = check_agreement(result, vehicle)
    return (None if disagreements else result), issues + disagreements


def duplicates(flights: list[Flight]) -> dict[str, str]:
    """Log name -> name of an earlier log with the same values."""
    first: dict[str, str] = {}
    copies = {}
    for flight in flights:
        original = first.setdefault(flight.fingerprint, flight.log)
        if original != flight.log:
            copies[flight.log] = original
    return copies


def _has_what_is_needed(flight: Flight, comparison: bool) -> None:
    if comparison:
        if not flight.has_motors:
            raise Refused("columns", "holds no motor commands (m1..m4), which a comparison needs")
        return
    # A gyroscope beside the motors shows what torques do; nothing less shows anything.
    if not (flight.has_pose or flight.body_rates is not None):
        pose = "x, y, z, qw, qx, qy, qz"
        imu = "gyroscope (wx, wy, wz), best with accelerometer (ax, ay, az)"
        raise Refused("columns", f"needs position and orientation ({pose}) or {imu}")
    if not (flight.has_motors or flight.has_commands):
        raise Refused(
            "columns", "holds no commands: needs m1..m4, or cmd_thrust and cmd_wx, cmd_wy, cmd_wz"
        )


def _with_forces(flight: Flight, note) -> Flight:
    """The flight, noted where it holds nothing that a force moves."""
    if not (flight.has_pose or flight.has_imu):
        note(
            "columns", "neither accelerometer nor pose: only torques can be judged; log ax, ay, az"
        )
    return flight
