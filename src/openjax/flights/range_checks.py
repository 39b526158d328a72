"""Values that no flight of such a vehicle has: units and corrupt columns that show by their
size alone.
"""

import dataclasses

import numpy as np

from openjax.flights.flight import CHANNEL_COLUMNS, Flight, Refused

# share of rows at one largest value from which that is the sensor's end
SATURATED = 0.01
OFTEN = 0.05  # share from which the sensor is of no use
# rad/s: rotors of such vehicles end below, and a hundredth of it would lift nothing
FASTEST_ROTOR = 10_000.0
LEAST_RANGE = {"body_rates": 0.3, "specific_force": 15.0}  # rad/s, m/s^2
# m: beyond, three coordinates that are one number are a mark, and no place
NOWHERE = 20.0


def _of_unit_length(quaternion: np.ndarray, note) -> np.ndarray:
    """Quaternions (T, 4) normalised, without flips; those far from unit length are not sampled."""
    norm = np.linalg.norm(quaternion, axis=1)
    norm[norm == 0.0] = np.nan
    off = np.abs(norm - 1.0)
    if np.nanmedian(off) > 0.05:
        text = f"quaternions aren't unit (norm {np.nanmedian(norm):.3g}): wrong columns or corrupt"
        raise Refused("quaternion", text)
    unit = quaternion / norm[:, None]
    bad = off > 0.05
    if bad.any():
        note("quaternion", f"{bad.sum()} quaternions far from unit length are taken as not sampled")
        unit[bad] = np.nan
    elif np.nanmax(off) > 2e-3:
        note(
            "quaternion",
            f"quaternions were off unit length by up to {np.nanmax(off):.1g} and are normalised",
        )
    return _without_flips(unit)


def in_range(flight: Flight, note) -> Flight:
    """Values that no flight of such a vehicle has: units and corrupt columns that show
    by their size alone.
    """
    changes = {}
    _refuse_commands(flight)
    flight = _without_saturated(_without_lost_poses(flight, note), note)
    if flight.quaternion is not None:
        changes["quaternion"] = _of_unit_length(flight.quaternion, note)
    # a hall's origin may be far away, but none of these flights goes so far
    if flight.position is not None and np.nanmax(np.abs(flight.position)) > 100.0:
        span = np.nanmax(np.ptp(flight.position[np.isfinite(flight.position).all(1)], axis=0))
        if span > 20.0:
            raise Refused("units", f"x, y, z span {span:.0f}: in cm or mm? The log format wants m")
    if flight.body_rates is not None:
        _refuse_degrees(flight.body_rates)
    voltage = flight.battery_voltage
    if voltage is not None:
        middle = float(np.nanmedian(voltage))
        if middle > 100:
            raise Refused("units", f"vbat is {middle:.0f}: in mV? The log format wants V")
        if not 2.0 < middle < 30.0:
            note("corrupt", f"vbat is {middle:.2g} V, which no battery in flight has; left out")
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


def _refuse_commands(flight: Flight) -> None:
    """Refuse commands that aren't shares of the largest, and rotor speeds that are none."""
    if flight.motor_command is not None:
        _share_of_one(flight.motor_command, "m1, m2, m3, m4")
    if flight.command_thrust is not None:
        _share_of_one(flight.command_thrust, "cmd_thrust")
    if flight.rotor_speed is not None:
        _refuse_revolutions(flight.rotor_speed)


def _refuse_revolutions(speed: np.ndarray) -> None:
    """Refuse rotor speeds (T, 4) that are none in rad/s."""
    low = float(np.nanmin(speed))
    high = float(np.nanmedian(np.abs(speed)))
    if high > FASTEST_ROTOR:
        text = f"w1, w2, w3, w4 are {high:.0f} in the median: in rpm? The log format wants rad/s"
        raise Refused("units", text)
    if high < 0.01 * FASTEST_ROTOR:
        text = f"w1, w2, w3, w4 are {high:.3g} in the median: not the rotors' speeds in rad/s"
        raise Refused("units", text)
    if low < -0.01 * high:
        raise Refused("corrupt", f"w1, w2, w3, w4 go down to {low:.0f}; speeds have no sign")


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
        text = f"{', '.join(c for c, ends in columns if ends)} read {most:g} or -{most:g}"
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
    """True if many more readings are the largest than the one below: else it is the
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
    note("corrupt", f"{is_lost.sum()} poses whose quaternion is zero are taken as not sampled")
    channels = [c for c in ("position", "quaternion") if getattr(flight, c) is not None]
    changes = {c: np.where(is_lost[:, None], np.nan, getattr(flight, c)) for c in channels}
    return dataclasses.replace(flight, **changes)


def _share_of_one(values: np.ndarray, columns: str) -> None:
    """Refuse commands that aren't shares of the largest, with what they look like."""
    low = float(np.nanmin(values))
    high = float(np.nanmax(values))
    # above 8-bit counts; pulses of servos end at 2,000 us
    if high > 256.0:
        hint = (
            "16-bit counts (divide by 65535), or rpm"
            if high > 2100
            else "a pulse width in microseconds"
        )
        raise Refused("units", f"{columns} reach {high:.0f}: {hint}; the log format wants 0..1")
    if high > 1.02:
        hint = "a wrong scale or corrupt"
        # per cent end at a hundred, 8-bit counts at 255
        if high > 101:
            hint = "8-bit counts"
        elif high > 2:
            hint = "per cent"
        raise Refused("units", f"{columns} reach {high:.3g}: {hint}; the log format wants 0..1")
    if low < -0.02:
        raise Refused("corrupt", f"{columns} go down to {low:.3g}; commands lie in 0..1")


def _without_flips(quaternion: np.ndarray) -> np.ndarray:
    """The same attitudes without jumps between q and -q."""
    rows = np.flatnonzero(np.isfinite(quaternion).all(1))
    flips = (quaternion[rows[1:]] * quaternion[rows[:-1]]).sum(1) < 0
    sign = np.ones(len(quaternion))
    sign[rows[1:]] = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quaternion * sign[:, None]
