"""Checks of flight logs: what can be mended is mended and named, what can't be used is
refused with a reason.
"""

import dataclasses

import numpy as np

from openjax.flights.agreement import check_agreement, other_frames
from openjax.flights.attitude import derive_attitude
from openjax.flights.derived import derive_rates, derive_velocity, mend_velocity
from openjax.flights.flight import CHANNEL_COLUMNS, Flight, Issue, Refused
from openjax.flights.sampling import (
    SLOWEST,
    drop_frozen,
    drop_held_rows,
    drop_repeats,
    put_in_step,
    runs_of,
    several_recordings,
)

SHORTEST = 2.0  # s airborne: windows of 0.5 s, and a few of them
# m below the floor, where nothing flies: more than an origin on a table is off by
BELOW = 0.3
AT_REST = 0.02  # command below which a motor doesn't turn
LONG_REST = 1.0  # s
# share of rows at one largest value from which that is the sensor's end
SATURATED = 0.01
OFTEN = 0.05  # share from which the sensor is of no use
LEAST_RANGE = {"body_rates": 0.3, "specific_force": 15.0}  # rad/s, m/s^2
# m: beyond, three coordinates that are one number are a mark, and no place
NOWHERE = 20.0
GROUND_CLEARANCE = 0.02  # m above the floor


def check_flight(
    flight: Flight, vehicle, log: dict | None = None, comparison: bool = False
) -> tuple[Flight | None, list[Issue]]:
    """Check one flight as read. Returns it sorted, cleaned and cut to its airborne
    part, or None if it can't be used, and the findings. `vehicle` is the nominal
    vehicle, `log` the vehicle file's `[log]` table (floor_z). For a `comparison` of
    flights with flights the motor commands alone are enough, and every airborne stretch
    is kept, not only the longest.
    """
    issues: list[Issue] = []

    def note(kind: str, text: str) -> None:
        issues.append(Issue(flight.name, text, kind=kind))

    # in this order: time before what is cut by it, motors before sensors that stand
    # still with them, ranges before anything is derived from values that can't be
    try:
        _has_what_is_needed(flight, comparison)
        checked = _while_motors_turn(_in_time(_with_forces(flight, note), note), note)
        checked = drop_held_rows(checked, note)
        checked = put_in_step(drop_repeats(drop_frozen(checked, note), note), note)
        checked = _in_range(checked, note)
        checked = derive_velocity(mend_velocity(checked, note), note)
        checked = derive_attitude(derive_rates(checked, note), note)
        floor = (log or {}).get("floor_z")
        checked = _airborne(checked, floor, note, comparison)
        _above_floor(checked, 0.0 if floor is None else float(floor))
        _has_what_is_needed(checked, comparison)
    except Refused as refused:
        return None, [
            *issues,
            Issue(flight.name, str(refused), refused=True, kind=refused.kind),
        ]
    found = check_agreement(checked, vehicle)
    return (None if found else checked), issues + found


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
            raise Refused(
                "columns", "holds no motor commands (m1..m4), which a comparison needs"
            )
        return
    # A gyroscope beside the motors shows what torques do; nothing less shows anything.
    if not (flight.has_pose or flight.body_rates is not None):
        pose = "x, y, z, qw, qx, qy, qz"
        imu = "gyroscope (wx, wy, wz), best with accelerometer (ax, ay, az)"
        raise Refused("columns", f"needs position and orientation ({pose}) or {imu}")
    if not (flight.has_motors or flight.has_commands):
        raise Refused(
            "columns",
            "holds no commands: needs m1..m4, or cmd_thrust and cmd_wx, cmd_wy, cmd_wz",
        )


def _with_forces(flight: Flight, note) -> Flight:
    """The flight, noted where it holds nothing that a force moves."""
    if not (flight.has_pose or flight.has_imu):
        note(
            "columns",
            "no accelerometer, nor a pose: torques alone can be told; log ax, ay, az",
        )
    return flight


def _in_time(flight: Flight, note) -> Flight:
    """Sorted by time, in seconds, without repeated rows."""
    time = flight.time
    finite = np.isfinite(time)
    if not finite.all():
        note("time", f"{(~finite).sum()} rows without a time are left out")
        flight = flight.rows(finite)
        time = flight.time
    if len(time) < 20:
        raise Refused("short", f"only {len(time)} row{'s' * (len(time) != 1)}")
    flight = _sorted(_written_once(flight, note), note)
    repeated = np.diff(flight.time) == 0
    if repeated.mean() > 0.2:
        raise Refused(
            "time",
            f"{repeated.mean():.0%} of the rows repeat the time of the row before: the clock is "
            "frozen, or too coarse",
        )
    if repeated.any():
        note(
            "time",
            f"{repeated.sum()} rows repeat the time of the row before and are left out",
        )
        flight = flight.rows(np.r_[True, ~repeated])
    step = flight.row_period
    _refuse_units(step)
    steps = np.diff(flight.time)
    gaps = np.flatnonzero(steps > max(5 * step, 0.05))
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        number = f"{len(gaps)} gap{'s' * (len(gaps) > 1)}"
        where = (
            f"the longest {steps[longest]:.2f} s after t = {flight.time[longest]:.2f}"
        )
        note("gaps", f"{number} in time, {where}")
    return flight


def _while_motors_turn(flight: Flight, note) -> Flight:
    """Without the time before motors first turn and after they last do: what stands
    still there is a vehicle on the ground, not a frozen sensor.
    """
    drive = (
        flight.motor_command
        if flight.motor_command is not None
        else flight.command_thrust
    )
    if drive is None:
        return flight
    turning = np.flatnonzero((drive.reshape(len(drive), -1) > AT_REST).any(1))
    if not len(turning):
        return flight
    part = slice(turning[0], turning[-1] + 1)
    seconds = flight.duration - (flight.time[part.stop - 1] - flight.time[part.start])
    if seconds < LONG_REST:
        return flight
    note("ground", f"{seconds:.1f} s with motors at rest are cut away")
    return flight.rows(part)


def _sorted(flight: Flight, note) -> Flight:
    """Rows out of order are sorted: a few, or any number of one recording, whose rows
    are then evenly apart. Others are several recordings.
    """
    backwards = int((np.diff(flight.time) < 0).sum())
    if not backwards:
        return flight
    in_order = _written_once(flight.rows(np.argsort(flight.time, kind="stable")), note)
    if problem := several_recordings(flight.time, in_order.time):
        raise Refused("time", problem)
    note("time", f"{backwards} rows out of order in time were sorted")
    return in_order


def _written_once(flight: Flight, note) -> Flight:
    """Without rows that repeat the one before in every column, as where a log was
    written twice.
    """
    channels = [
        getattr(flight, c) for c in CHANNEL_COLUMNS if getattr(flight, c) is not None
    ]
    table = np.column_stack([flight.time, *(v.reshape(len(v), -1) for v in channels)])
    same = (table[1:] == table[:-1]) | (np.isnan(table[1:]) & np.isnan(table[:-1]))
    repeated = np.r_[False, same.all(1)]
    if not repeated.any():
        return flight
    note("time", f"{repeated.sum()} rows that stand twice were left out")
    return flight.rows(~repeated)


def _refuse_units(step: float) -> None:
    """Refuse rows that are too far apart or too close, in seconds."""
    if step > SLOWEST:
        for unit, factor in (
            ("milliseconds", 1e3),
            ("microseconds", 1e6),
            ("nanoseconds", 1e9),
        ):
            if 5e-4 <= step / factor <= SLOWEST:
                counted = " or counts rows" if step == 1.0 else ""
                raise Refused(
                    "units",
                    f"t is in {unit}{counted} (rows {step:g} apart); the log format "
                    "wants seconds",
                )
        raise Refused(
            "time", f"rows are {step:g} s apart; at least 20 rows per second are needed"
        )
    if step < 2e-4:
        raise Refused(
            "units",
            f"rows are {step:g} s apart: t is not in seconds, or the clock is corrupt",
        )


def _of_unit_length(quaternion: np.ndarray, note) -> np.ndarray:
    """Quaternions (T, 4) normalised, without flips; those far from unit length are not
    sampled.
    """
    norm = np.linalg.norm(quaternion, axis=1)
    norm[norm == 0.0] = np.nan
    off = np.abs(norm - 1.0)
    if np.nanmedian(off) > 0.05:
        text = f"quaternions aren't unit (norm {np.nanmedian(norm):.3g}): wrong columns or corrupt"
        raise Refused("quaternion", text)
    unit = quaternion / norm[:, None]
    bad = off > 0.05
    if bad.any():
        note(
            "quaternion",
            f"{bad.sum()} quaternions far from unit length are taken as not sampled",
        )
        unit[bad] = np.nan
    elif np.nanmax(off) > 2e-3:
        note(
            "quaternion",
            f"quaternions were off unit length by up to {np.nanmax(off):.1g} and are normalised",
        )
    return _without_flips(unit)


def _in_range(flight: Flight, note) -> Flight:
    """Values that no flight of such a vehicle has: units and corrupt columns that show
    by their size alone.
    """
    changes = {}
    motor = flight.motor_command
    if motor is not None:
        _share_of_one(motor, "m1, m2, m3, m4")
    if flight.command_thrust is not None:
        _share_of_one(flight.command_thrust, "cmd_thrust")
    flight = _without_saturated(_without_lost_poses(flight, note), note)
    if flight.quaternion is not None:
        changes["quaternion"] = _of_unit_length(flight.quaternion, note)
    if flight.position is not None and np.nanmax(np.abs(flight.position)) > 100.0:
        span = np.nanmax(
            np.ptp(flight.position[np.isfinite(flight.position).all(1)], axis=0)
        )
        if span > 20.0:
            raise Refused(
                "units", f"x, y, z span {span:.0f}: in cm or mm? The log format wants m"
            )
    if flight.body_rates is not None:
        _refuse_degrees(flight.body_rates)
    voltage = flight.battery_voltage
    if voltage is not None:
        middle = float(np.nanmedian(voltage))
        if middle > 100:
            raise Refused(
                "units", f"vbat is {middle:.0f}: in mV? The log format wants V"
            )
        if not 2.0 < middle < 30.0:
            note(
                "corrupt",
                f"vbat is {middle:.2g} V, which no battery in flight has; left out",
            )
            changes["battery_voltage"] = None
    return dataclasses.replace(flight, **changes) if changes else flight


def _refuse_degrees(body_rates: np.ndarray) -> None:
    """Refuse body rates (T, 3) that are none in rad/s: ten turns a second are beyond
    the full scale of such gyroscopes.
    """
    fastest = np.nanmax(np.abs(body_rates))
    if fastest > 60.0:
        text = f"wx, wy, wz reach {fastest:.0f}: in deg/s? The log format wants rad/s"
        raise Refused("units", text)


def _without_saturated(flight: Flight, note) -> Flight:
    """A sensor at the end of its range reads what it can, not what there is: not
    sampled, or of no use where that is often so.
    """
    changes = {}
    for channel in ("body_rates", "specific_force"):
        values = getattr(flight, channel)
        if values is None:
            continue
        size = np.abs(values)
        most = float(np.nanmax(size))
        at_end = size == most
        share = float(at_end.any(1).mean())
        if share < SATURATED or most < LEAST_RANGE[channel] or not _piled_up(size):
            continue
        columns = zip(CHANNEL_COLUMNS[channel], at_end.any(0), strict=True)
        text = (
            f"{', '.join(c for c, ends in columns if ends)} read {most:g} or -{most:g}"
        )
        text += f" in {share:.0%} of the rows, the sensor's end"
        if share < OFTEN:
            note("corrupt", f"{text}: taken as not sampled there")
            changes[channel] = np.where(at_end.any(1)[:, None], np.nan, values)
            continue
        if channel == "body_rates" and flight.quaternion is None:
            raise Refused("corrupt", f"{text}: a larger range is needed")
        note("corrupt", f"{text}: left out")
        changes[channel] = None
    return dataclasses.replace(flight, **changes) if changes else flight


def _piled_up(size: np.ndarray) -> bool:
    """Whether many more readings are the largest than the one below: else it is the
    peak of a motion, which a coarse sensor reads often.
    """
    _, counts = np.unique(size[np.isfinite(size)], return_counts=True)
    return len(counts) > 1 and bool(counts[-1] > 5 * counts[-2])


def _without_lost_poses(flight: Flight, note) -> Flight:
    """Cameras that lost a body write zeros, or a number that is no place, -999 for one:
    such a pose isn't sampled.
    """
    place = flight.position
    if place is not None:
        nowhere = (place == place[:, :1]).all(1) & (np.abs(place[:, 0]) > NOWHERE)
        if nowhere.any() and not nowhere.all():
            value = place[nowhere][0, 0]
            note(
                "corrupt",
                f"{nowhere.sum()} rows whose x, y, z all are {value:g} are taken as not sampled",
            )
            place = np.where(nowhere[:, None], np.nan, place)
            flight = dataclasses.replace(flight, position=place)
    if flight.quaternion is None:
        return flight
    is_lost = (flight.quaternion == 0.0).all(1)
    if not is_lost.any():
        return flight
    note(
        "corrupt",
        f"{is_lost.sum()} poses whose quaternion is zero are taken as not sampled",
    )
    channels = [c for c in ("position", "quaternion") if getattr(flight, c) is not None]
    changes = {
        c: np.where(is_lost[:, None], np.nan, getattr(flight, c)) for c in channels
    }
    return dataclasses.replace(flight, **changes)


def _share_of_one(values: np.ndarray, columns: str) -> None:
    """Refuse commands that aren't shares of the largest, with what they look like."""
    low = float(np.nanmin(values))
    high = float(np.nanmax(values))
    if high > 256.0:
        hint = (
            "16-bit counts (divide by 65535), or rpm"
            if high > 2100
            else "a pulse width in microseconds"
        )
        raise Refused(
            "units", f"{columns} reach {high:.0f}: {hint}; the log format wants 0..1"
        )
    if high > 1.02:
        hint = "a wrong scale or corrupt"
        if high > 101:
            hint = "8-bit counts"
        elif high > 2:
            hint = "per cent"
        raise Refused(
            "units", f"{columns} reach {high:.3g}: {hint}; the log format wants 0..1"
        )
    if low < -0.02:
        raise Refused(
            "corrupt", f"{columns} go down to {low:.3g}; commands lie in 0..1"
        )


def _without_flips(quaternion: np.ndarray) -> np.ndarray:
    """The same attitudes without jumps between q and -q."""
    rows = np.flatnonzero(np.isfinite(quaternion).all(1))
    flips = (quaternion[rows[1:]] * quaternion[rows[:-1]]).sum(1) < 0
    sign = np.ones(len(quaternion))
    sign[rows[1:]] = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quaternion * sign[:, None]


def _airborne(
    flight: Flight, floor_z: float | None, note, every: bool = False
) -> Flight:
    """Cut to the longest airborne stretch, or to `every` one of a useful length. Off
    the ground: motors give at least 40 % of their usual command, and the vehicle isn't
    at rest on the floor; shorter dips (half a second) are manoeuvres.
    """
    drive = (
        flight.motor_command
        if flight.motor_command is not None
        else flight.command_thrust
    )
    drive = drive if drive.ndim == 1 else drive.mean(1)
    rows = np.isfinite(drive)
    drive = np.interp(flight.time, flight.time[rows], drive[rows])
    # the median of the upper half: a long wait on the ground doesn't take it down
    usual = np.median(drive[drive >= np.median(drive)])
    if usual < 0.02:
        raise Refused(
            "short",
            f"never took off: the commands reach {np.max(drive):.2g} of their range, or are in "
            "another unit",
        )
    on_ground = _long_runs(drive < 0.4 * usual, flight.time)
    if flight.position is not None and flight.velocity is not None:
        floor = 0.0 if floor_z is None else float(floor_z)
        height = flight.interpolated("position")[:, 2] - floor
        speed = np.linalg.norm(flight.interpolated("velocity"), axis=1)
        on_ground |= (np.abs(height) < GROUND_CLEARANCE) & (speed < 0.05)
    runs = runs_of(~on_ground)
    if not runs:
        raise Refused("short", "never took off")
    start, stop = max(runs, key=lambda r: flight.time[r[1] - 1] - flight.time[r[0]])
    airborne = flight.time[stop - 1] - flight.time[start]
    if airborne < SHORTEST:
        raise Refused(
            "short",
            f"airborne for {airborne:.1f} s only; at least {SHORTEST:g} s are needed",
        )
    if every:
        kept = np.zeros(len(flight), bool)
        for first, last in runs:
            kept[first:last] = flight.time[last - 1] - flight.time[first] >= SHORTEST
        return flight.rows(kept)
    if stop - start < len(flight):
        cut = flight.duration - airborne
        kept = f"t = {flight.time[start]:.2f} to {flight.time[stop - 1]:.2f}"
        note("ground", f"{cut:.1f} s on the ground are cut away (kept: {kept})")
        flight = flight.rows(slice(start, stop))
    return flight


def _above_floor(flight: Flight, floor: float) -> None:
    """Nothing flies below the floor."""
    if flight.position is None:
        return
    height = float(np.nanmedian(flight.position[:, 2])) - floor
    if height < -BELOW:
        if words := other_frames(flight):
            raise Refused("axes", words)
        raise Refused(
            "axes",
            f"z is {height + floor:.2f} m in flight, below the floor at {floor:g}: z points up "
            "(scale = -1 in columns.toml), or floor_z is what z reads on the floor",
        )


def _long_runs(
    flags: np.ndarray, time: np.ndarray, shortest: float = 0.5
) -> np.ndarray:
    """`flags` (T,) without runs of less than `shortest` s: a dip of thrust in the air
    is a manoeuvre.
    """
    long = flags.copy()
    for start, stop in runs_of(flags):
        if time[stop - 1] - time[start] < shortest:
            long[start:stop] = False
    return long
