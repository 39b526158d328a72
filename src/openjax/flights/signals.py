"""Signals of a flight on one even clock, for the checks that compare channels with each other."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.signal.windows import tukey
from scipy.spatial.transform import Rotation

from openjax.flights.flight import SENSORS, Flight
from openjax.flights.shapes import Columns, Quaternions, Times, Vectors

RATE = 100.0  # Hz, common clock of the comparisons
LONGEST = 30.0  # s, enough to tell
SHORTEST = 1.5  # s, less tells nothing
COMPARED = (*SENSORS, "motor_command", "command_body_rates")
FADE = 0.5  # s


def clock_of(flight: Flight) -> Times | None:
    """The common clock over the longest stretch without gaps, and without holes in a channel, over
    which nothing may be drawn; None if that is too short to tell anything.
    """
    steps = np.diff(flight.time)
    long_steps = np.flatnonzero(steps > max(0.1, 5 * flight.row_period))
    gaps = np.stack([flight.time[long_steps], flight.time[long_steps + 1]], 1)
    channels = [c for c in COMPARED if getattr(flight, c) is not None]
    holes = [flight.holes(channel) for channel in channels]
    start, stop = _longest_without(np.concatenate([gaps, *holes]), flight.time)
    if stop - start < SHORTEST:  # holes everywhere: lines over them are all there is
        start, stop = _longest_without(gaps, flight.time)
    if stop - start < SHORTEST:
        return None
    return np.arange(start, min(stop, start + LONGEST), 1 / RATE)


def _longest_without(gaps: np.ndarray, time: np.ndarray) -> tuple[float, float]:
    """Begin and end (s) of the longest stretch of times (T,) outside gaps (G, 2)."""
    gaps = gaps[np.argsort(gaps[:, 0])]
    starts = np.maximum.accumulate(np.r_[time[0], gaps[:, 1]])
    stops = np.r_[gaps[:, 0], time[-1]]
    longest = int(np.argmax(stops - starts))
    return float(starts[longest]), float(stops[longest])


def on_clock(flight: Flight, channel: str, grid: Times) -> Columns | None:
    """A channel (T, C) on the common clock; fast channels are averaged over the clock's
    period first.
    """
    values = getattr(flight, channel)
    if values is None:
        return None
    at, values = flight.sampled(channel)
    if len(at) < 10:
        return None
    values = values.reshape(len(values), -1)
    step = float(np.median(np.diff(at)))
    if step < 0.7 / RATE and channel != "quaternion":
        width = round(1 / (RATE * step))
        values = uniform_filter1d(values, width, axis=0, mode="nearest")
    out = np.stack([np.interp(grid, at, column) for column in values.T], 1)
    return out / np.linalg.norm(out, axis=1, keepdims=True) if channel == "quaternion" else out


def in_band(values: Columns, band: tuple[float, float]) -> Float[np.ndarray, "inner columns"]:
    """`values` (T, C) between two frequencies, without delay, and without the ends
    where that isn't right.
    """
    # rows at the ends where filter and differences aren't trustworthy
    edge = min(20, len(values) // 8)
    # faded in and out: a filter this slow would carry the last row's noise far into the flight
    fade = _fade(len(values))[:, None]
    signal = fade * (values - values.mean(0))
    return sosfiltfilt(_bandpass(band), signal, axis=0)[edge:-edge]


@lru_cache(maxsize=32)
def _bandpass(band: tuple[float, float]) -> np.ndarray:
    return butter(2, band, "bandpass", fs=RATE, output="sos")


@lru_cache(maxsize=32)
def _fade(rows: int) -> np.ndarray:
    return tukey(rows, min(1.0, 2 * FADE * RATE / rows))


def rates_of(quaternion: Quaternions) -> Vectors:
    """Body rates (T, 3) rad/s of attitudes (T, 4) on the common clock, by central differences."""
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    rates = (attitude[:-2].inv() * attitude[2:]).as_rotvec() * RATE / 2
    return np.concatenate([rates[:1], rates, rates[-1:]])


def first_order(values: Columns, time_constant: float) -> Columns:
    """`values` (T, C) behind a first-order lag of `time_constant` s, settled at the start."""
    blend = -np.expm1(-1 / (RATE * time_constant))
    start = (1.0 - blend) * values[:1]
    return lfilter([0.0, blend], [1.0, blend - 1.0], values, axis=0, zi=start)[0]
