"""Checks of flight logs: what can be mended is mended and named, what can't be used is refused with a
reason."""

import dataclasses

import numpy as np

from openjax.flights.agreement import check_agreement
from openjax.flights.flight import CHANNELS, Flight, Issue
from openjax.flights.reading import CHANNEL_COLUMNS

SHORTEST = 2.0  # s airborne: windows of 0.5 s, and a few of them
SLOWEST = 0.05  # s between rows
FROZEN = 0.5  # s without a change of a sensor that has noise
HELD = 0.1  # share of rows that repeat the one before, from which a sensor is slower than the rows
IN_STEP = 50  # poses from which a clock of their own is looked for
IN_PHASE = 0.25  # concentration of their phases (0 to 1) from which they have one
EDGE = 0.03  # cycles of that clock by which its phase may be wrong
RATE_NOISE = 0.04  # rad/s of body rates that are derived: what gyroscopes of such vehicles have at most
BESIDE_GAP, GAP, OUTSIDE = 4, 1.5, 6.0  # rows, usual steps, deviations: of a velocity that a gap has spoilt
GROUND_CLEARANCE = 0.02  # m above the floor
SENSORS = ("position", "quaternion", "velocity", "body_rates", "specific_force")


class _Refused(Exception):
    def __init__(self, kind: str, reason: str):
        super().__init__(reason)
        self.kind = kind


def check_flight(
    flight: Flight, vehicle, log: dict | None = None, comparison: bool = False
) -> tuple[Flight | None, list[Issue]]:
    """Check one flight as read. Returns it sorted, cleaned and cut to its airborne part, or None if it can't
    be used, and the findings. `vehicle` is the nominal vehicle, `log` the vehicle file's `[log]` table
    (floor_z). For a `comparison` of flights with flights the motor commands alone are enough, and every
    airborne stretch is kept, not only the longest."""
    issues: list[Issue] = []

    def note(kind: str, text: str) -> None:
        issues.append(Issue(flight.name, text, kind=kind))

    try:
        _has_what_is_needed(flight, comparison)
        checked = _in_time(flight, note)
        checked = _in_step(_without_repeats(_clean(checked, note), note), note)
        checked = _in_range(checked, note)
        checked = _derive_velocity(_velocity_at_gaps(checked, note), note)
        checked = _derive_rates(checked, note)
        checked = _airborne(checked, (log or {}).get("floor_z"), note, comparison)
        _has_what_is_needed(checked, comparison)
    except _Refused as refused:
        return None, [*issues, Issue(flight.name, str(refused), refused=True, kind=refused.kind)]
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
            raise _Refused("columns", "holds no motor commands (m1..m4), which a comparison needs")
        return
    if not (flight.has_pose or flight.has_imu):
        pose, imu = "x, y, z, qw, qx, qy, qz", "ax, ay, az, wx, wy, wz"
        sensors = f"position and orientation ({pose}) or accelerometer and gyroscope ({imu})"
        raise _Refused("columns", f"needs {sensors}")
    if not (flight.has_motors or flight.has_commands):
        raise _Refused("columns", "holds no commands: needs m1..m4, or cmd_thrust and cmd_wx, cmd_wy, cmd_wz")


def _in_time(flight: Flight, note) -> Flight:
    """Sorted by time, in seconds, without repeated rows."""
    time = flight.time
    finite = np.isfinite(time)
    if not finite.all():
        note("time", f"{(~finite).sum()} rows without a time are left out")
        flight = flight.rows(finite)
        time = flight.time
    if len(time) < 20:
        raise _Refused("short", f"only {len(time)} rows")
    flight = _sorted(flight, note)
    repeated = np.diff(flight.time) == 0
    if repeated.mean() > 0.2:
        text = f"{repeated.mean():.0%} of the rows repeat the time of the row before (frozen clock)"
        raise _Refused("time", text)
    if repeated.any():
        note("time", f"{repeated.sum()} rows repeat the time of the row before and are left out")
        flight = flight.rows(np.r_[True, ~repeated])
    step = flight.row_period
    _refuse_units(step)
    steps = np.diff(flight.time)
    gaps = np.flatnonzero(steps > max(5 * step, 0.05))
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        note("gaps", f"{len(gaps)} gap{'s' * (len(gaps) > 1)} in time, the longest {steps[longest]:.2f} s "
                     f"after t = {flight.time[longest]:.2f}")  # fmt: skip
    return flight


def _sorted(flight: Flight, note) -> Flight:
    """A few rows out of order are sorted; more are several recordings."""
    steps = np.diff(flight.time)
    backwards = int((steps < 0).sum())
    if not backwards:
        return flight
    if (steps < -1.0).any() or backwards > 0.05 * len(flight.time):
        at = flight.time[int(np.argmin(steps))]
        text = f"time runs backwards (after t = {at:g}): unsorted, or several recordings in one file"
        raise _Refused("time", text)
    note("time", f"{backwards} rows out of order in time were sorted")
    return flight.rows(np.argsort(flight.time, kind="stable"))


def _refuse_units(step: float) -> None:
    """Refuse rows that are too far apart or too close, in seconds."""
    if step > SLOWEST:
        for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
            if 5e-4 <= step / factor <= SLOWEST:
                raise _Refused("units", f"t is in {unit} (rows {step:g} apart); the log format wants seconds")
        raise _Refused("time", f"rows are {step:g} s apart; at least 20 rows per second are needed")
    if step < 2e-4:
        raise _Refused("units", f"rows are {step:g} s apart: t is not in seconds, or the clock is corrupt")


def _clean(flight: Flight, note) -> Flight:
    """Constant columns refuse or drop their channel; frozen stretches become not sampled; holes are named."""
    changes = {}
    for channel in (c for c in CHANNELS if getattr(flight, c) is not None):
        values, names = getattr(flight, channel), ", ".join(CHANNEL_COLUMNS[channel])
        rows = np.flatnonzero(np.isfinite(values.reshape(len(values), -1)).all(1))
        if len(rows) < 2:
            raise _Refused("corrupt", f"{names}: hardly any row holds a number")
        if channel in SENSORS or channel == "motor_command":
            frozen = _standing_still(flight, channel, rows, note)
            if frozen.any():
                changes[channel] = _unsampled(values, frozen)
                rows = rows[~frozen[rows]]
        if channel != "battery_voltage" and len(rows) > 1:
            _name_hole(flight.time, rows, names, note)
    return dataclasses.replace(flight, **changes) if changes else flight


def _standing_still(flight: Flight, channel: str, rows, note) -> np.ndarray:
    """(T,) rows in which a sensor is frozen; of columns that never change nothing can be used."""
    columns, values = CHANNEL_COLUMNS[channel], getattr(flight, channel)
    table = values.reshape(len(values), -1)
    changed = np.diff(table[rows], axis=0) != 0
    together = channel in ("position", "quaternion", "velocity")
    dead = [] if together and changed.any() else np.flatnonzero(~changed.any(0))
    if len(dead):
        names = ", ".join(columns[i] for i in dead)
        raise _Refused("corrupt", f"{names}: the same value {table[rows[0], dead[0]]:g} in every row")
    frozen = _frozen(table, rows, flight.time, together)
    if frozen.any():
        share, start = frozen.mean(), flight.time[np.argmax(frozen)]
        words = f"{', '.join(columns)} stand still for {share * flight.duration:.1f} s from t = {start:.2f}"
        if share > 0.5:
            raise _Refused("corrupt", f"{words}: frozen for {share:.0%} of the flight")
        note("corrupt", f"{words}; taken as not sampled there")
    return frozen


def _name_hole(time, rows, names: str, note) -> None:
    """Say where the longest stretch without samples is, if rows are there meanwhile: else it is a gap in time, named already."""
    steps = np.diff(time[rows])
    hole = int(np.argmax(steps))
    if rows[hole + 1] - rows[hole] > 1 and steps[hole] > max(0.2, 10 * np.median(steps)):
        note("gaps", f"{names}: not sampled for {steps[hole]:.2f} s after t = {time[rows][hole]:.2f}")


def _without_repeats(flight: Flight, note) -> Flight:
    """A sensor that is slower than the rows and whose last sample was written again counts as sampled where it changed.
    A sample that appears in a row may be older than it by up to a row."""
    changes = {}
    for group in (("position", "quaternion", "velocity"), ("body_rates", "specific_force")):
        logged = [c for c in group if getattr(flight, c) is not None]
        if not logged:
            continue
        together = np.concatenate([getattr(flight, c).reshape(len(flight), -1) for c in logged], 1)
        repeated = np.r_[False, (np.diff(together, axis=0) == 0).all(1)]
        if repeated.mean() < HELD:
            continue
        note(
            "held",
            f"{repeated.mean():.0%} of the rows repeat the last sample of {', '.join(logged)}: left out",
        )
        for channel in logged:
            changes[channel] = _unsampled(getattr(flight, channel), repeated)
        if group[0] == "position":
            changes["pose_age"] = flight.row_period
    return dataclasses.replace(flight, **changes) if changes else flight


def _in_step(flight: Flight, note) -> Flight:
    """Poses at the times of their rows, where the camera is slower than the log: a row says only that a new pose came since the
    last one, and the camera's own clock is regular. Poses are on a line through their rows; a held one is half a row late on
    the mean."""
    logged = [c for c in ("position", "quaternion", "velocity") if getattr(flight, c) is not None]
    if not logged:
        return flight
    rows = np.flatnonzero(
        np.all([np.isfinite(getattr(flight, c).reshape(len(flight), -1)).all(1) for c in logged], 0)
    )
    if len(rows) < IN_STEP or len(rows) > (1.0 - HELD) * len(flight):
        return flight
    seen = flight.time[rows]
    own = _regular_clock(seen, flight.row_period)
    if own is None:
        return flight
    own = own - 0.5 * flight.pose_age
    changes = {"pose_age": 0.0}
    for channel in logged:
        values = getattr(flight, channel)
        moved = np.full_like(values, np.nan)
        moved[rows] = np.stack([np.interp(seen, own, column) for column in values[rows].T], 1)
        changes[channel] = moved
    rate = (len(own) - 1) / (own[-1] - own[0])
    note("held", f"poses come at {rate:.0f} Hz of a clock of their own: moved from it to the rows' times")
    return dataclasses.replace(flight, **changes)


def _regular_clock(seen: np.ndarray, row: float) -> np.ndarray | None:
    """Times (S,) of a regular clock whose ticks were seen at times (S,) up to a `row` s apart from it, later where rows are
    missing; None where they have none. Its rate is where the phases of what was seen agree most (Rayleigh's periodogram)."""
    since = seen - seen[0]
    usual = (len(seen) - 1) / since[-1]
    rates = np.arange(0.9 * usual, 1.15 * usual, 0.2 / since[-1])
    turned = np.exp(2j * np.pi * rates[:, None] * since).mean(1)
    best = int(np.argmax(np.abs(turned)))
    if np.abs(turned[best]) < IN_PHASE:
        return None
    middle = np.angle(turned[best]) / (2.0 * np.pi)
    late = rates[best] * since - middle + 0.5 * row * rates[best]  # cycles since a tick could first be seen
    ticks = np.floor(late + EDGE)
    usual = late - ticks < row * rates[best] + EDGE
    slope, start = np.polyfit(ticks[usual], seen[usual], 1)
    return start + slope * ticks


def _unsampled(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values (T, ...) without those of some rows (T,)."""
    left = values.copy()
    left[rows] = np.nan
    return left


def _frozen(table: np.ndarray, rows: np.ndarray, time: np.ndarray, together: bool) -> np.ndarray:
    """(T,) True in runs of at least FROZEN seconds in which a column (all columns if `together`) doesn't
    change though it does elsewhere. Runs at the column's extremes are saturation, not a frozen sensor."""
    values = table[rows]
    still = np.diff(values, axis=0) == 0
    extreme = (values == values.min(0)) | (values == values.max(0))
    per_column = [still.all(1)] if together else [s & ~e for s, e in zip(still.T, extreme[1:].T, strict=True)]
    frozen = np.zeros(len(time), bool)
    for run in per_column:
        for start, stop in _runs(run):
            if time[rows[stop]] - time[rows[start]] >= FROZEN:
                frozen[rows[start] + 1 : rows[stop] + 1] = True
    return frozen


def _of_unit_length(quaternion: np.ndarray, note) -> np.ndarray:
    """Quaternions (T, 4) normalised, without flips; those far from unit length are not sampled."""
    norm = np.linalg.norm(quaternion, axis=1)
    off = np.abs(norm - 1.0)
    if np.nanmedian(off) > 0.05:
        text = f"quaternions aren't unit (norm {np.nanmedian(norm):.3g}): wrong columns or corrupt"
        raise _Refused("quaternion", text)
    unit, bad = quaternion / norm[:, None], off > 0.05
    if bad.any():
        note("quaternion", f"{bad.sum()} quaternions far from unit length are taken as not sampled")
        unit[bad] = np.nan
    elif np.nanmax(off) > 2e-3:
        note(
            "quaternion", f"quaternions were off unit length by up to {np.nanmax(off):.1g} and are normalised"
        )
    return _without_flips(unit)


def _in_range(flight: Flight, note) -> Flight:
    """Values that no flight of such a vehicle has: units and corrupt columns that show by their size
    alone."""
    changes = {}
    motor = flight.motor_command
    if motor is not None:
        _share_of_one(motor, "m1, m2, m3, m4")
    if flight.command_thrust is not None:
        _share_of_one(flight.command_thrust, "cmd_thrust")
    if flight.quaternion is not None:
        changes["quaternion"] = _of_unit_length(flight.quaternion, note)
    if flight.position is not None and np.nanmax(np.abs(flight.position)) > 100.0:
        span = np.nanmax(np.ptp(flight.position[np.isfinite(flight.position).all(1)], axis=0))
        if span > 20.0:
            raise _Refused("units", f"x, y, z span {span:.0f}: in mm? The log format wants m")
    if flight.body_rates is not None and np.nanmax(np.abs(flight.body_rates)) > 60.0:
        raise _Refused("units", f"wx, wy, wz reach {np.nanmax(np.abs(flight.body_rates)):.0f}: in deg/s? "
                                "The log format wants rad/s")  # fmt: skip
    voltage = flight.battery_voltage
    if voltage is not None:
        middle = float(np.nanmedian(voltage))
        if middle > 100:
            raise _Refused("units", f"vbat is {middle:.0f}: in mV? The log format wants V")
        if not 2.0 < middle < 30.0:
            note("corrupt", f"vbat is {middle:.2g} V, which no battery in flight has; left out")
            changes["battery_voltage"] = None
    return dataclasses.replace(flight, **changes) if changes else flight


def _share_of_one(values: np.ndarray, columns: str) -> None:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high > 256.0:
        hint = "16-bit counts; divide by 65535" if high > 2100 else "a pulse width in microseconds"
        raise _Refused("units", f"{columns} reach {high:.0f}: {hint}; the log format wants 0..1")
    if high > 1.02:
        hint = "8-bit counts" if high > 101 else "per cent" if high > 2 else "a wrong scale or corrupt"
        raise _Refused("units", f"{columns} reach {high:.3g}: {hint}; the log format wants 0..1")
    if low < -0.02:
        raise _Refused("corrupt", f"{columns} go down to {low:.3g}; commands lie in 0..1")


def _without_flips(quaternion: np.ndarray) -> np.ndarray:
    """The same attitudes without jumps between q and -q."""
    rows = np.flatnonzero(np.isfinite(quaternion).all(1))
    flips = (quaternion[rows[1:]] * quaternion[rows[:-1]]).sum(1) < 0
    sign = np.ones(len(quaternion))
    sign[rows[1:]] = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quaternion * sign[:, None]


def _derive_velocity(flight: Flight, note) -> Flight:
    """Velocity from position where it wasn't logged: local quadratic fits over about 50 ms
    (Savitzky-Golay)."""
    if flight.velocity is not None or flight.position is None:
        return flight
    time, position = flight.sampled("position")
    half = max(2, round(0.025 / max(float(np.median(np.diff(time))), 1e-4)))
    velocity = np.full((len(flight), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(flight.position).all(1))
    if len(rows) < 2 * half + 1:
        raise _Refused("short", f"only {len(rows)} rows hold a position")
    velocity[rows], reach = _slopes(time, position, half)
    jump = reach > 0.25
    velocity[rows[jump]] = np.nan
    note("columns", "no velocity was logged: it is derived from position")
    return dataclasses.replace(flight, velocity=velocity, velocity_derived=True)


def _velocity_at_gaps(flight: Flight, note) -> Flight:
    """A velocity that somebody differentiated row by row is wrong beside rows that are missing: there it is taken from the
    position, where it is far off its slope for such rows alone."""
    if flight.velocity is None or flight.position is None:
        return flight
    rows = np.flatnonzero(np.isfinite(flight.position).all(1) & np.isfinite(flight.velocity).all(1))
    if len(rows) < 10 * BESIDE_GAP:
        return flight
    time = flight.time[rows]
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > GAP * np.median(steps))
    beside = np.zeros(len(rows), bool)
    for shift in range(-BESIDE_GAP, BESIDE_GAP):
        beside[np.clip(gaps + 1 + shift, 0, len(rows) - 1)] = True
    if not beside.any() or beside.mean() > 0.5:
        return flight
    slope, reach = _slopes(time, flight.position[rows], BESIDE_GAP - 1)
    off = flight.velocity[rows] - slope
    usual = 1.4826 * np.median(np.abs(off[~beside]), axis=0) + 1e-6
    wrong = beside & (np.abs(off) > OUTSIDE * usual).any(1) & (reach < 0.25)
    if not wrong.any():
        return flight
    velocity = flight.velocity.copy()
    velocity[rows[wrong]] = slope[wrong]
    note(
        "gaps",
        f"velocity in {wrong.sum()} rows beside missing ones contradicts the position: taken from it there",
    )
    return dataclasses.replace(flight, velocity=velocity)


def _slopes(time: np.ndarray, values: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (R, C) of values (R, C) by local quadratic fits over 2 `half` + 1 rows (Savitzky-Golay, for
    uneven steps too), and how far in time (R,) each fit reaches."""
    index = np.clip(np.arange(len(time)), half, len(time) - half - 1)[:, None] + np.arange(-half, half + 1)
    dt = time[index] - time[:, None]
    basis = np.stack([np.ones_like(dt), dt, dt**2], -1)
    normal = np.einsum("rki,rkj->rij", basis, basis)
    moment = np.einsum("rki,rkc->ric", basis, values[index])
    scale = np.array([1.0, 1e-2, 1e-4])  # keeps the normal equations well conditioned
    solved = np.linalg.solve(normal / np.outer(scale, scale), moment / scale[:, None])
    return solved[:, 1] / scale[1], np.abs(dt).max(1)


def _derive_rates(flight: Flight, note) -> Flight:
    """Body rates from the attitude where no gyroscope was logged: w = 2 (q* dq/dt), local quadratic fits."""
    if flight.body_rates is not None or flight.quaternion is None:
        return flight
    time, attitude = flight.sampled("quaternion")
    step = max(float(np.median(np.diff(time))), 1e-4)
    half = max(2, round(0.025 / step))
    if len(time) < 2 * half + 1:
        return flight
    half = min(half, _enough(attitude, step))
    slope, reach = _slopes(time, attitude, half)
    w, x, y, z = attitude.T
    dw, dx, dy, dz = slope.T
    rates = 2.0 * np.stack([
        w * dx - x * dw - y * dz + z * dy,
        w * dy - y * dw - z * dx + x * dz,
        w * dz - z * dw - x * dy + y * dx,
    ], 1)  # fmt: skip
    rates[reach > 0.25] = np.nan
    derived = np.full((len(flight), 3), np.nan)
    derived[np.isfinite(flight.quaternion).all(1)] = rates
    note("columns", "no gyroscope was logged: body rates are derived from the attitude")
    return dataclasses.replace(flight, body_rates=derived, body_rates_derived=True)


def _enough(attitude: np.ndarray, step: float) -> int:
    """Rows to either side over which the slope of attitudes (R, 4) is no noisier than RATE_NOISE: a wide fit takes the
    edge off every turn, and an estimator's attitude, which is smooth, doesn't need it."""
    # Third differences hold little motion; of white noise s they are sqrt(20) s, and their median size .6745 of that.
    noise = float(np.median(np.abs(np.diff(attitude, 3, axis=0)))) / (0.6745 * np.sqrt(20.0))
    half = 1
    while half < len(attitude) // 2 and 2.0 * noise / step > RATE_NOISE * np.sqrt(
        half * (half + 1) * (2 * half + 1) / 3.0
    ):
        half += 1
    return half


def _airborne(flight: Flight, floor_z: float | None, note, every: bool = False) -> Flight:
    """Cut to the longest airborne stretch, or to `every` one of a useful length. Off the ground: motors give
    at least 40 % of their usual command, and the vehicle isn't at rest on the floor; shorter dips (half a
    second) are manoeuvres."""
    drive = flight.motor_command if flight.motor_command is not None else flight.command_thrust
    drive = drive if drive.ndim == 1 else drive.mean(1)
    rows = np.isfinite(drive)
    drive = np.interp(flight.time, flight.time[rows], drive[rows])
    usual = np.median(drive[drive >= np.median(drive)])
    if usual < 0.02:
        raise _Refused("short", "never took off: the commands stay near zero")
    on_ground = _long_runs(drive < 0.4 * usual, flight.time)
    if flight.position is not None and flight.velocity is not None:
        floor = 0.0 if floor_z is None else float(floor_z)
        height = flight.interpolated("position")[:, 2] - floor
        speed = np.linalg.norm(flight.interpolated("velocity"), axis=1)
        on_ground |= (np.abs(height) < GROUND_CLEARANCE) & (speed < 0.05)
    runs = _runs(~on_ground)
    if not runs:
        raise _Refused("short", "never took off")
    start, stop = max(runs, key=lambda r: flight.time[r[1] - 1] - flight.time[r[0]])
    airborne = flight.time[stop - 1] - flight.time[start]
    if airborne < SHORTEST:
        raise _Refused("short", f"airborne for {airborne:.1f} s only; at least {SHORTEST:g} s are needed")
    if every:
        kept = np.zeros(len(flight), bool)
        for first, last in runs:
            kept[first:last] = flight.time[last - 1] - flight.time[first] >= SHORTEST
        return flight.rows(kept)
    if stop - start < len(flight):
        cut = flight.duration - airborne
        note("ground", f"{cut:.1f} s on the ground are cut away (kept: t = {flight.time[start]:.2f} "
                       f"to {flight.time[stop - 1]:.2f})")  # fmt: skip
        flight = flight.rows(slice(start, stop))
    return flight


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First row and the one after the last of every stretch in which `flags` (T,) hold."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags, 0]))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _long_runs(flags: np.ndarray, time: np.ndarray, shortest: float = 0.5) -> np.ndarray:
    """`flags` (T,) without runs of less than `shortest` s: a dip of thrust in the air is a manoeuvre."""
    kept = flags.copy()
    for start, stop in _runs(flags):
        if time[stop - 1] - time[start] < shortest:
            kept[start:stop] = False
    return kept
