"""The moment at which motors act, from their commands and the turning of the body, without a fit of
any cause.

Torques turn the body at once: the angular acceleration that motors would make, through their lag,
is where the cross-correlation with what the gyroscope reads is largest (Knapp, Carter 1976). Roll
and pitch tell it: in yaw rotors that speed up turn the body before their drag does, which looks
like a row's shift. It may come later than the motors' lag says, as slow motors and late links do,
and earlier, as quick motors do. It is another clock only where no lag explains it: then a row of
commands holds what acted before it, or the two streams are on different clocks.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, find_peaks, sosfiltfilt

from openjax.flights.flight import Case
from openjax.flights.grid import GRID_PERIOD, MAX_GAP, MISSED_SAMPLES
from openjax.flights.motor_delay import lag_and_delay, row_torques
from openjax.flights.track import Track, earlier, turn_increments

# What a row of motor commands may hold: their mean from its time until the next row,
# their mean since the last row, or a single one.
ROWS = ("mean", "mean_before", "sample")
BAND = (0.7, 8.0)  # Hz: above trims, below what single samples of motors hide
EDGE = 0.4  # s at either end that the filter spoils
REACH = 0.3  # s by which the streams may be apart
FINER = 4  # steps of an offset in a row of the grid
LOUD = 3.0  # times the median size, at which the signals are cut
FOLLOWS = 0.25  # mean squared correlation from which motors and turning belong together
BETTER = 0.9  # share of it that a peak at another offset may have, and be as good
# s that motors may seem early beside half a row: the largest in 120 cases of four
# simulators was .0025 (steps of an offset are as long)
EARLY = 0.003
REACH_OF_LAGS = 0.1  # s of delay up to which lags are tried beside it
CLEARLY = 8.0  # nats by which a delay must beat all lags
# Share of a flight's likeness at its own offset that it has at the common one of all
# flights, from which it tells no other: where a flight hardly turns the curve is flat.
TELLS = 0.85
SLOWEST_ROW = 0.004  # s: rows that are shorter hide nothing by a row's shift
# s that motors may seem late by: a time constant of .13 s looks like .05 in this band
LATE = 0.06
LINK = 0.1  # s: no link that one can fly by takes as long
APART = 0.03  # s by which flights of one logger may differ


@dataclass(frozen=True)
class MotorClock:
    """`late` {flight and vehicle: s by which its motor commands stand later in the log
    than they act}; `one_clock`: whether motors and gyroscope share one, but for a row;
    `findings` in words, by name.
    """

    late: dict[str, float]
    one_clock: bool
    findings: dict[str, str]


def read_motor_clock(
    tracks: Sequence[Track], vehicles, row: float, rows: str = "mean", gyroscope: bool = True
) -> MotorClock:
    """Compare motors and turning of all tracks of one case with their nominal
    `vehicles`. `row`: s between the log's own rows; `rows`: what is said of them, see
    ROWS; without `gyroscope` the attitude says how the body turns.
    """
    both = zip(tracks, vehicles, strict=True)
    turning = (_turning(t, v, gyroscope) for t, v in both if t.motor is not None)
    row_time = row if rows == "mean_before" else 0.0
    by_a_row = dict.fromkeys(map(_flight_of, tracks), row)
    delays = {flight: -d for flight, d in _offsets(turning).items()}
    usual = float(np.median(list(delays.values()))) if delays else row_time
    least = _least(row, rows)
    alike = not delays or max(delays.values()) - min(delays.values()) < APART
    # what gusts and wakes turn the loop answers late: flights in them needn't be alike
    times = (usual,) if alike else delays.values()
    in_time = MotorClock(by_a_row if row_time else {}, True, {})
    if all(-LATE < delay - row_time <= least for delay in times):
        return in_time
    if alike:
        usual = _beyond_lags(
            tracks, vehicles, gyroscope, usual, (row_time - LATE, row_time + least)
        )
        if usual is None:
            return in_time
        delays = dict.fromkeys(delays, usual)
        if not row_time and row >= SLOWEST_ROW and least < usual < 1.5 * row + EARLY:
            text = (
                f"motor commands act {1e3 * usual:.0f} ms before their row: rows hold what acted "
                "since the last one, and are read one row earlier"
            )
            return MotorClock(by_a_row, True, {"motor rows": text})
    # what tells no clock has that of the others, where these are alike
    rest = dict.fromkeys(by_a_row, usual) if alike else {}
    return MotorClock(rest | delays, False, {"motor clock": _apart(delays, least, gyroscope)})


def _apart(delays: dict[str, float], least: float, gyroscope: bool) -> str:
    """In words that motors are on another clock, and by how much in which flights."""
    words = _in_words({flight: time for flight, time in delays.items() if abs(time) > least})
    return (
        f"motors and {'gyroscope' if gyroscope else 'attitude'} don't share a clock: motor "
        f"commands are {words}; they are moved by that, and torques, lags and latencies can't be "
        "told from these logs"
    )


def _beyond_lags(
    tracks: Sequence[Track], vehicles, gyroscope: bool, offset: float, usual: tuple[float, float]
) -> float | None:
    """s by which motor commands are late where no lag of the motors explains that they
    seem so, by an `offset`; None where one does, with a delay in `usual` limits.
    """
    with_motors = [(t, v) for t, v in zip(tracks, vehicles, strict=True) if t.motor is not None]
    if abs(offset) >= REACH_OF_LAGS or len({t.dt for t, _ in with_motors}) > 1:
        return offset
    (first, vehicle), *_ = with_motors
    lags = lag_and_delay(
        [(_rates(t, gyroscope), t.motor) for t, _ in with_motors],
        np.asarray(vehicle.rotor_position, float),
        first.dt,
        REACH_OF_LAGS,
    )
    if lags is None:
        return offset
    return None if lags.against(-usual[1], -usual[0]) < CLEARLY else -lags.delay


def _least(row: float, rows: str) -> float:
    """s by which motors may seem early: half a row, of the grid's where the log's own
    are shorter, and another half where rows are single samples.
    """
    half = 0.5 * (row if row >= SLOWEST_ROW else GRID_PERIOD)
    return half + EARLY + (0.5 * row if rows == "sample" else 0.0)


def _in_words(delays: dict[str, float]) -> str:
    """The delay of each flight."""
    return ", ".join(
        f"{1e3 * abs(time):.0f} ms {'late' if time > 0 else 'early'} in {flight}"
        for flight, time in delays.items()
    )


def on_gyroscope_clock(track: Track, clock: MotorClock) -> Track:
    """The track with its motor commands when they act. Without one clock they tell the
    thrust and no torques.
    """
    delay = clock.late.get(_flight_of(track), 0.0)
    if track.motor is None or (delay == 0.0 and clock.one_clock):
        return track
    fast = track.fast_thrust
    return dataclasses.replace(
        track,
        motor=earlier(track.motor, -delay, track),
        fast_thrust=None if fast is None else (fast[0] - delay, fast[1]),
        motors_logged=track.motors_logged and clock.one_clock,
    )


def case_on_gyroscope_clock(case: Case, delays: Mapping[str, float]) -> Case:
    """A case whose flights hold their motor commands when they act, see `MotorClock.late`."""
    flights = []
    for flight in case.flights:
        delay = delays.get(flight.name, 0.0)
        if delay and flight.motor_command is not None:
            acting = flight.time + delay
            motor = flight.interpolated("motor_command", acting)
            for begin, end in flight.holes("motor_command", MAX_GAP, MISSED_SAMPLES):
                motor[(acting > begin) & (acting < end)] = np.nan
            flight = dataclasses.replace(flight, motor_command=motor)
        flights.append(flight)
    return dataclasses.replace(case, flights=tuple(flights))


def read_command_clock(tracks: Sequence[Track], row: float) -> str:
    """The fault of the clock of commanded thrust against the motors, which follow it after the
    link's delay; empty if there is none.
    """
    both = [t for t in tracks if t.command is not None and t.motor is not None]
    pairs = ((t, t.motor.mean(1)[:, None], t.command[:, :1]) for t in both)
    delays = {f: -d for f, d in _offsets(pairs).items() if not -1.5 * row - EARLY < d < LINK}
    return (
        f"commands and motors don't share a clock: commands are {_in_words(delays)}; they aren't "
        "used, and link and rate controller can't be told from these logs"
        if delays
        else ""
    )


def _flight_of(track: Track) -> str:
    """The flight and vehicle whose stretch a track is."""
    return track.name.split("#")[0]


def _offsets(signals) -> dict[str, float]:
    """{flight and vehicle: s by which one signal (T, C) is later than the other}, of
    `signals` (track, that one, the other) that are alike.
    """
    likeness: dict[str, list] = {}
    for track, effect, cause in signals:
        if (correlation := _likeness(effect, cause, track.dt)) is not None:
            likeness.setdefault(_flight_of(track), []).append((correlation, track.dt / FINER))
    curves = {}
    for flight, parts in likeness.items():
        # Stretches of one flight may have rows of another length: all on the grid of the shortest.
        reach = min(len(part) // 2 * step for part, step in parts)
        step = parts[0][1]
        grid = step * np.arange(-int(reach / step), int(reach / step) + 1)
        mean_curve = sum(_on(grid, values, row) for values, row in parts) / len(parts)
        if mean_curve.max() >= FOLLOWS:
            curves[flight] = mean_curve, step
    out = {flight: _peak(curve, step) for flight, (curve, step) in curves.items()}
    # one logger has one clock, unless a flight tells another one clearly
    if len(curves) > 1:
        reach = min(len(mean_curve) // 2 * step for mean_curve, step in curves.values())
        step = min(step for _, step in curves.values())
        grid = step * np.arange(-int(reach / step), int(reach / step) + 1)
        alike = {f: _on(grid, curve, row) for f, (curve, row) in curves.items()}
        common = _peak(sum(alike.values()), step)
        for flight, mean_curve in alike.items():
            if np.interp(common, grid, mean_curve) >= TELLS * mean_curve.max():
                out[flight] = common
    return out


def _peak(likeness: np.ndarray, step: float) -> float:
    """The offset, s, of the highest peak of a curve (N,) around zero; of peaks that are
    as high that of the one in the middle, as where a flight is periodic.
    """
    best, middle = int(np.argmax(likeness)), len(likeness) // 2
    high = find_peaks(likeness, BETTER * likeness[best], distance=int(APART / step))[0]
    if len(high):
        best = int(high[np.argmin(np.abs(high - middle))])
    return (best - middle) * step


def _on(grid: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    """Values (N,) at steps around zero, on another grid."""
    return np.interp(grid, step * (np.arange(len(values)) - len(values) // 2), values)


def _likeness(effect: np.ndarray, cause: np.ndarray, dt: float) -> np.ndarray | None:
    """Squared correlation, with its sign, of two signals (T, C) at offsets up to REACH
    in steps of a row / FINER; mean of the columns.
    """
    edge = int(EDGE / dt)
    if len(effect) < 4 * edge:
        return None
    # of slow rows the band ends before the highest frequency that they can hold
    band = butter(2, (BAND[0], min(BAND[1], 0.4 / dt)), "bandpass", fs=1 / dt, output="sos")
    bands = (sosfiltfilt(band, v, axis=0)[edge:-edge] for v in (effect, cause))
    # The one turn at a start outweighs a whole flight.
    effect, cause = (np.clip(v, -u, u) for v in bands for u in [LOUD * np.median(np.abs(v), 0)])
    size = 1 << int(np.ceil(np.log2(2 * len(effect))))
    spectrum = np.fft.rfft(effect, size, axis=0) * np.conj(np.fft.rfft(cause, size, axis=0))
    steps = int(REACH / dt) * FINER
    cross = FINER * np.fft.irfft(spectrum, FINER * size, axis=0)
    cross = np.concatenate([cross[-steps:], cross[: steps + 1]])
    power = np.sqrt((effect**2).sum(0) * (cause**2).sum(0))
    correlation = cross / np.maximum(power, 1e-12)
    return (np.abs(correlation) * correlation).mean(1)


def _turning(track: Track, vehicle, gyroscope: bool) -> tuple[Track, np.ndarray, np.ndarray]:
    """The track, its angular acceleration and that which its motors make, but for their
    units, (T - 1, 2), in roll and pitch.
    """
    acceleration = np.diff(_rates(track, gyroscope)[:, :2], axis=0) / track.dt
    lag = float(vehicle.motor_time_constant)
    torques = row_torques(track.motor, np.asarray(vehicle.rotor_position, float), lag, track.dt)
    return track, acceleration, torques[:-1]


def _rates(track: Track, gyroscope: bool) -> np.ndarray:
    """Body rates (T, 3), by the gyroscope or by the attitude."""
    if gyroscope and track.body_rates is not None:
        return track.body_rates
    increments = turn_increments(track.quaternion) / track.dt
    return 0.5 * (
        np.concatenate([increments[:1], increments]) + np.concatenate([increments, increments[-1:]])
    )
