"""The path from commands to motors: the radio and the rate controller, read without any dynamics.

The mean of the motor commands is the commanded thrust, so its delay and its lost packets show row by row;
what the motors differ by is the rate controller's output."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track, held_means, smooth
from openjax.gap.feedback import Gains, in_force, outputs_of
from openjax.gap.linear_path import LinearPath, fit_linear_path
from openjax.gap.observer import GYRO_GAIN, observe
from openjax.gap.prediction import bucket, padded

GAIN_STEP = 0.05
GAIN_SPREAD = 0.4
# Share of a gain that a firmware's own filters and limits may imitate, for p, i, d.
GAIN_TOLERANCE = (0.02, 0.4, 0.15)
GYRO_TILT = 0.01  # rad, between the logged gyro and the one that the controller uses
FILTER_DELAY = 0.003  # s, of low-passes in the firmware
LONGEST_DELAY = 0.1  # s
DELAY_STEP = 0.0005  # s
TOLERANCE = 3e-4  # of thrust: rounding of the logs and of the firmware's integers
READABLE = 3e-3  # of thrust: mean misfit above which motors and commands aren't one stream
EXPLAINED = 0.5  # of the misfit without a delay, above which the link isn't late
INFORMATIVE = 1.5e-3  # smallest change of commanded thrust that shows what the link does at all
HELD = (
    0.2  # of the way from the command that was due to the one held: nearer to the latter, the packet was lost
)
BETWEEN = 0.6  # of that way: rows up to here that don't hold it are neither; a lost packet leaves none
MOST_BETWEEN = 0.5  # of them per lost packet; where rows lie anywhere between two commands, it is one
MOST_BETWEEN_SINGLE = 1.0  # the same where a row holds one command: a busy sender's leave some, and over three where none is lost


@dataclass(frozen=True, eq=False)
class Radio:
    """What the link did. `gain` maps a set of its effects to its log-likelihood gain over a perfect link;
    `arrived` [(fraction, (T, 2) rows)]: the command in force at the end and at the start of each row,
    and the share of the row that the older one rules; `misfit` is the mean error of the collective
    thrust per set. `informative` rows have a new command; `told` ones are so clear that they tell whether it arrived, and
    `loss` is the share of them in which it didn't; `between` counts those that neither hold the old command nor follow the
    new one, per lost packet. `single` says whether the motors were sampled so often that a row holds one command only."""

    delay: float
    loss: float
    between: float
    gain: dict
    arrived: dict
    misfit: dict
    informative: int
    told: int
    single: bool = False

    @property
    def readable(self) -> bool:
        """Whether the motors' stream follows the commands closely enough to tell single packets."""
        return self.misfit["command_latency", "packet_loss"] < READABLE

    def shown(self, known, clock: float, least_loss: float, least: float) -> tuple[str, ...]:
        """Of the effects `known` those that the link shows: a delay beyond what clocks may differ by, more lost packets
        than a share `least_loss` and a number `least`.

        What a delay doesn't explain isn't late: streams that were put onto the rows afterwards disagree everywhere. Nor are
        packets lost where as many rows lie between two commands: a delay that jitters, or clocks that do, leave those.
        """
        if not self.readable:
            return ()
        at_once = min(self.misfit[()], self.misfit["packet_loss",])
        later = min(self.misfit["command_latency",], self.misfit["command_latency", "packet_loss"])
        late = "command_latency" in known and self.delay > clock and later < EXPLAINED * at_once
        lost = "packet_loss" in known and self.loss > least_loss and self.loss * self.told > least
        lost = lost and self.between < (MOST_BETWEEN_SINGLE if self.single else MOST_BETWEEN)
        return tuple(n for n, on in (("command_latency", late), ("packet_loss", lost)) if on)


def read_radio(tracks: list[Track]) -> Radio:
    """Delay and lost packets from the commanded thrust against the mean of the motor commands."""
    delays = np.arange(0.0, LONGEST_DELAY, DELAY_STEP)
    misfit = sum(_delay_misfit(t, delays) for t in tracks)
    delay = float(delays[int(np.argmin(misfit))])
    perfect, straight = _decode(tracks, 0.0, False), _decode(tracks, 0.0, True)
    late, both = _decode(tracks, delay, False), _decode(tracks, delay, True)
    names = {
        (): perfect,
        ("command_latency",): late,
        ("packet_loss",): straight,
        ("command_latency", "packet_loss"): both,
    }
    level = {name: _scale(found) for name, found in names.items()}
    used = both if delay > 0 else straight
    return Radio(
        delay,
        used["lost"] / max(used["told"], 1),
        used["between"] / max(used["lost"], 1),
        {name: level[name] - level[()] for name in names},
        {name: found["arrived"] for name, found in names.items()},
        {
            name: float(np.mean(np.abs(found["error"]))) if len(found["error"]) else 0.0
            for name, found in names.items()
        },
        used["informative"],
        used["told"],
        all(track.fast_thrust is not None for track in tracks),
    )


def _scale(found) -> float:
    """Log-likelihood of the errors under a Laplace distribution of unknown scale; a third of the rows is
    counted as independent."""
    error = np.abs(found["error"])
    return float(-len(error) / 3.0 * np.log(error.mean() + TOLERANCE)) if len(error) else 0.0


def _clean_rows(track: Track) -> np.ndarray:
    clean = ((track.motor < 0.997) & (track.motor > 0.003)).all(1)
    clean[: int(LONGEST_DELAY / track.dt) + 2] = False
    return clean


def _delay_misfit(track: Track, delays: np.ndarray) -> np.ndarray:
    thrust, clean = track.command[:, 0], _clean_rows(track)
    cap = 0.3 * np.std(np.diff(thrust)) + 1e-9  # a lost packet must not pull at the delay
    return np.array([np.minimum(np.abs(_late_error(track, d)[clean]), cap).sum() for d in delays])


def _late_error(track: Track, delay: float) -> np.ndarray:
    """(T,) mean of the motors less the commanded thrust of `delay` s ago."""
    whole, part, given, _ = _link_rows(track, delay)
    thrust = track.command[:, 0]
    return given - (1 - part) * _late(thrust, whole) - part * _late(thrust, whole + 1)


def _late(values: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], rows, 0), values[: len(values) - rows]])


def _rows_late(track: Track, delay: float) -> tuple[int, float]:
    """A delay (s) in rows: whole ones and the rest."""
    whole = int(delay / track.dt + 1e-9)
    return whole, delay / track.dt - whole


def _link_rows(track: Track, delay: float) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Rows in which commands of `delay` s ago are in force: whole rows late, the share of a row that the one before still
    rules, the motors' mean (T,), whether it can be read (T,). Logs faster than the rows are cut anew where the commands
    arrive, so that a row holds one command."""
    clean = _clean_rows(track)
    if track.fast_thrust is None:
        return *_rows_late(track, delay), track.motor.mean(1), clean
    given = held_means(*track.fast_thrust, track.time + delay, track.dt)
    rows = int(np.ceil(delay / track.dt - 1e-9))
    for later in range(1, rows + 1):  # what a row holds then is in these
        clean = clean & np.concatenate([clean[later:], np.zeros(min(later, len(clean)), bool)])
    return 0, 0.0, given, clean


def _decode(tracks, delay: float, may_lose: bool) -> dict:
    """Row by row: did the command due in this row arrive, or is the one before still held?"""
    errors, arrived, informative, told, lost, between = [], [], 0, 0, 0, 0
    for track in tracks:
        whole, part, given, clean = _link_rows(track, delay)
        error = np.abs(_late_error(track, delay)[clean])
        noise = float(np.median(error)) if len(error) else 0.0
        # the smallest change of thrust that shows whether a packet arrived
        telling = (TOLERANCE + 2.0 * noise) / HELD
        thrust, given, flags = track.command[:, 0].tolist(), given.tolist(), clean.tolist()
        held, in_force, error = 0, np.zeros(len(track), int), np.zeros(len(track))
        for row in range(len(track)):
            due = max(row - whole, 0)
            expected = (1 - part) * thrust[due] + part * thrust[held]
            missed = False
            change = abs(thrust[held] - expected)
            if flags[row] and change > INFORMATIVE:
                informative += 1
                way = abs(given[row] - thrust[held]) / change
                missed = may_lose and way < abs(given[row] - expected) / change
                if change > telling:
                    told += 1
                    lost += way < HELD
                    between += HELD <= way < BETWEEN
            error[row] = given[row] - (thrust[held] if missed else expected)
            if not missed:
                held = due
            in_force[row] = held
        errors.append(error[clean])
        if track.fast_thrust is not None:
            whole, part = _rows_late(track, delay)
            in_force = _late(in_force, whole)
        arrived.append((part, np.stack([in_force, _late(in_force, 1)], 1)))
    return {
        "error": np.concatenate(errors),
        "arrived": arrived,
        "informative": informative,
        "told": told,
        "lost": lost,
        "between": between,
    }


def with_motors(track: Track, vehicle) -> Track:
    """The track with motor commands: where they weren't logged, those that the nominal rate controller
    would send."""
    if track.motor is not None:
        return track
    rows = np.arange(len(track))
    link = (0.0, np.stack([rows, np.maximum(rows - 1, 0)], 1))
    track = dataclasses.replace(track, motor=np.repeat(track.command[:, :1], 4, 1))
    gains = np.ones((1, 3), np.float32)
    for _ in range(2):
        wanted, _ = _observe_twice(track, vehicle, link, gains)
        track = dataclasses.replace(track, motor=wanted[0], motors_logged=False)
    return track


def _observe_twice(track: Track, vehicle, link, gains, push=None, at_once=False):
    """The observer's output: mean motor commands wanted (B, T, 4), the same knowing the past only, and the
    commands sent in the ticks (T, TICKS, 4) with the first gains.

    What pushed the body beyond the nominal physics in a first run is given to a second, so that the rates
    inside a row are right whatever the physics."""
    rows, size = len(track), bucket(len(track))
    inputs = [padded(v, size) for v in (in_force(track, link), track.motor, track.body_rates)]
    push = padded(np.zeros((rows, 3)) if push is None else push, size)
    for _ in range(2):
        wanted, sent, rates = observe(gains, vehicle, *inputs, push, np.float32(track.dt), at_once)
        miss = track.body_rates[1:] - np.asarray(rates[0], float)[: rows - 1]
        step = miss.copy()  # undo the observer's own correction of what it missed before
        step[1:] -= (1.0 - GYRO_GAIN) * miss[:-1]
        push = push + padded(smooth(np.concatenate([step, step[-1:]]), 0.06, track.dt) / track.dt, size)
    return np.asarray(wanted, float)[:, :rows], np.asarray(sent[0])[:rows]


def gyro_noise(rates: np.ndarray) -> float:
    """White noise of a gyroscope log (T, 3), rad/s: from third differences, which motion hardly reaches at
    100 Hz."""
    return float(1.4826 * np.median(np.abs(np.diff(rates, 3, axis=0))) / np.sqrt(20.0))


@dataclass(frozen=True, eq=False)
class RateLoop:
    """The rate controller read from what the motors differ by: `path` fits its outputs row by row; the motor commands
    (T, TICKS, 4) of each track's `ticks`; `gains` of yaw, row by row, and what `with_gains` adds."""

    path: LinearPath
    ticks: list[np.ndarray]
    gains: Gains


def read_rate_loop(
    tracks, vehicles, arrived, flight_of, pushes=None, base=(0.0, 0.0, 0.0), at_once=False
) -> RateLoop:
    """Read the rate controllers of all tracks; `arrived` as in `Radio`. pushes [(T, 3)]: angular
    accelerations (rad/s^2) beyond the nominal that are already known; `base`: changes of the gains p, i, d
    around which the loop is linearised."""
    base = np.asarray(base, float)
    gains = (1.0 + base + np.concatenate([np.zeros((1, 3)), GAIN_STEP * np.eye(3)])).astype(np.float32)
    y, columns, nuisances, masks, ticks, noise = [], [], [], [], [], []
    for number, (track, vehicle, link) in enumerate(zip(tracks, vehicles, arrived, strict=True)):
        push = None if pushes is None else pushes[number]
        wanted, sent = _observe_twice(track, vehicle, link, gains, push, at_once)
        ticks.append(sent)
        outputs = outputs_of(vehicle)
        demand, logged = wanted @ outputs, track.motor @ outputs
        tied = (demand[1:] - demand[0]) / GAIN_STEP
        # Yaw has gains of its own.
        columns.append(np.concatenate([tied * [1.0, 1.0, 0.0], tied * [0.0, 0.0, 1.0]]))
        y.append(logged - demand[0] + np.tensordot(base, tied, 1))
        # What the gyroscope's noise does to the columns: a second dose of it, drawn.
        dose = gyro_noise(track.body_rates) * np.random.default_rng(number).standard_normal(
            track.body_rates.shape
        )
        noisy = dataclasses.replace(track, body_rates=track.body_rates + dose)
        loud = _observe_twice(noisy, vehicle, link, gains, push, at_once)[0] @ outputs
        more = (loud[1:] - loud[0]) / GAIN_STEP - tied
        noise.append(np.concatenate([more * [1.0, 1.0, 0.0], more * [0.0, 0.0, 1.0]]))
        time = (track.time - track.time[0])[:, None]
        integral = np.asarray(vehicle.rate_ki, float) * 57.3 / 65536.0
        seen = np.stack([np.cross(axis, track.body_rates) for axis in np.eye(3)]) * GYRO_TILT
        proportional = np.asarray(vehicle.rate_kp, float) * 57.3 / 65536.0
        trims = list(proportional * seen + integral * np.cumsum(seen, 1) * track.dt)
        trims += [
            f
            for axis in np.eye(3)
            for f in (0.3 * axis * np.ones_like(logged), 0.03 * axis * integral * time)
        ]
        # Low-passes before the gains delay what they act on, by times that aren't known.
        trims += [FILTER_DELAY * np.gradient(tied[k], track.dt, axis=0) for k in (0, 2)]
        nuisances.append(np.stack(trims))
        clean = ((track.motor < 0.997) & (track.motor > 0.003)).all(1)
        masks.append(1.0 - (np.convolve(~clean, np.ones(12))[: len(clean)] > 0))
    groups = (((0, 1), False), ((2,), False))
    spread = (GAIN_SPREAD,) * 6
    path = fit_linear_path(y, columns, nuisances, flight_of, spread, groups, masks, 2 * GAIN_TOLERANCE, noise)
    _, change, covariance = path.score()
    outputs = np.concatenate([(t.motor @ outputs_of(v))[:, 2] for t, v in zip(tracks, vehicles, strict=True)])
    left = float(np.concatenate(path.residual)[:, 2].var() / max(outputs.var(), 1e-12))
    yaw = float(change[3]), float(np.sqrt(covariance[3, 3]))
    return RateLoop(path, ticks, Gains(np.zeros(6), np.full(6, np.inf), yaw=yaw, yaw_left=left))


def with_gains(loop: RateLoop, gains: Gains) -> RateLoop:
    """The loop with `gains` read from what commands excite; yaw's stay those read row by row."""
    return dataclasses.replace(
        loop, gains=dataclasses.replace(gains, yaw=loop.gains.yaw, yaw_left=loop.gains.yaw_left)
    )
