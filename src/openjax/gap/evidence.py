"""Everything that a case's flights say about causes, before any decision: scores of sets, path by path."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.flights.track import GRID_PERIOD, Track, tracks_of
from openjax.gap import estimator, firmware
from openjax.gap.feedback import (
    AT_ONCE,
    AT_ONCE_SELDOM,
    MOST_LEFT,
    ROW_DELAY,
    Gains,
    answers_noise,
    caused_by_commands,
    gustiness,
    outputs_of,
    read_feedback,
    read_gains,
)
from openjax.gap.firmware import Radio
from openjax.gap.hypotheses import SetFit, model_noise, weigh_singles, without_nuisances
from openjax.gap.kinematics import Kinematics, corrected, read_kinematics
from openjax.gap.library import ABSENT, CARDS, GUSTY, NUISANCES, PWM_NUISANCES, SAMPLED_NUISANCES, Library
from openjax.gap.linear_path import LinearPath
from openjax.gap.observer import TICKS
from openjax.gap.replay import Replay, make_replay

CLEAR_DELAY = 0.002  # s of pose delay above which the pose is moved before the physics is read
CLEAR_SCORE = 3.0  # nats, likewise
LOOKS = 2  # at most
WORTH_KNOWING = 15.0  # nats that an effect must add to be taken as known in the next look
WORTH_A_SECOND_LOOK = 30.0  # nats of the best set above none
FEW_ROWS = 2.4  # of a log in one of the grid's: if they are samples, their mean isn't what five ticks of the loop did
ALIKE_LEFT = 0.8  # of what yaw's outputs leave as means: by so much less, they are single samples,
APART_LEFT = 0.4  # and by so much less as means, they are means
LEAST_KICK = 0.1  # of the motors' outputs within a row: below, samples are as good as means
MOST_GUSTS = 0.25  # of the torques that commands cause: from then on feedback is all that is seen of them
HEAVY = 0.1  # of the moments of inertia, that single samples taken for means may feign
RADIO_COST = 15.0  # nats that a radio effect must gain before the rate loop is read with it


@dataclass(frozen=True, eq=False)
class Evidence:
    """Scores are log marginal likelihoods above that of no effect (nats). `sets` holds physics sets: a
    full fit or a linearised score; `exposure` what a typical effect would show. None: that path wasn't
    logged."""

    case: Case
    library: Library
    tracks: list[Track]
    vehicles: list
    replay: Replay
    sets: dict[tuple[str, ...], SetFit]
    exposure: dict[str, float]
    floor: list[np.ndarray]  # (T, 9) residuals when all effects may act at once: sensors and gusts
    feigned: frozenset[str]  # what gusts or samples look like: it takes what it can, and isn't named
    radio: Radio | None
    rate_loop: LinearPath | None
    gains: Gains | None
    pose: LinearPath | None
    sensors: Kinematics
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def nothing(self) -> SetFit:
        return self.sets[()]


class Look(NamedTuple):
    """One look at the physics: the replay, what each set explains, what typical effects would show, the residuals that are
    floor, the effects that gusts or samples feign, and the rate loop's path and gains (None without commands)."""

    replay: Replay
    sets: dict[tuple[str, ...], SetFit]
    exposure: dict[str, float]
    floor: list[np.ndarray]
    feigned: frozenset[str]
    rate_loop: LinearPath | None
    gains: Gains | None


@dataclass(frozen=True, eq=False)
class Reading:
    """How the rows of a case are read. `arrived`: the commands that the link let through, None without commands; `pwm`:
    motors are duty cycles; `at_once`: a row's motors are one sample; `blind`: what motors do within a row isn't known;
    `late` s: by how much they may be off against the gyroscope, None where that isn't known either; `loops` {at_once: the rate
    loop read so, of the nominal vehicle}, where they were read."""

    tracks: list[Track]
    vehicles: list
    arrived: list | None
    flight_of: np.ndarray
    sensors: Kinematics
    pwm: bool
    at_once: bool = False
    blind: bool = False
    late: float | None = None
    loops: dict[bool, firmware.RateLoop] = field(default_factory=dict)

    @property
    def numbers(self):
        return PWM_NUISANCES if self.pwm else SAMPLED_NUISANCES if self.blind else NUISANCES

    @cached_property
    def by_commands(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """`caused_by_commands` of each track."""
        links = self.arrived if self.arrived is not None else [None] * len(self.tracks)
        return [caused_by_commands(*of) for of in zip(self.tracks, self.vehicles, links, strict=True)]


def gather(case: Case, library: Library, progress=None) -> Evidence:
    """Read a case by all its paths. Raises UserError where no stretch of flight is long enough."""
    tell = progress or (lambda text: None)
    seconds, clock = {}, time.perf_counter()

    def lap(name):
        nonlocal clock
        now = time.perf_counter()
        seconds[name], clock = seconds.get(name, 0.0) + now - clock, now

    if case.vehicle_file.mass_weighed:
        library = Library(tuple(e for e in library.effects if e != "mass"))
    tell("reading the paths of the log")
    tracks = [t for t in tracks_of(case) if t.motor is not None or t.command is not None]
    if not tracks:
        raise UserError(
            f"{case.name}: no flight has 2 s without a gap, with body rates and commands or motors"
        )
    flights = {f.name: f for f in case.flights}
    vehicles = [case.vehicle_of(flights[t.name.split("#")[0]]) for t in tracks]
    names = list(dict.fromkeys(t.flight for t in tracks))
    flight_of = np.array([names.index(t.flight) for t in tracks])

    late = "state_latency" in library.effects
    pose, tracks = _pose(tracks, flight_of, late)
    sensors = read_kinematics(tracks)
    if not sensors.one_clock:
        pose = None
    if sensors.upright is not None or sensors.findings:
        tracks = [corrected(t, sensors) for t in tracks]
        if pose is not None:
            pose = estimator.read_estimator(tracks, flight_of) if not _late(pose) else pose
    radio, arrived = None, None
    tracks = [firmware.with_motors(t, v) for t, v in zip(tracks, vehicles, strict=True)]
    if all(t.command is not None and t.motors_logged for t in tracks):
        radio = firmware.read_radio(tracks)
        allowed = {k: v for k, v in radio.gain.items() if all(e in library.effects for e in k)}
        if not radio.readable:
            allowed = {(): 0.0}
        arrived = radio.arrived[max(allowed, key=lambda k: allowed[k] - RADIO_COST * len(k))]
    # Faster logs are averaged anyway.
    shortest = min(f.row_period for f in case.flights)
    slow = shortest > 0.8 * GRID_PERIOD
    few = not slow and GRID_PERIOD / shortest < FEW_ROWS
    derived = any(f.body_rates_derived for f in case.flights)
    reading = Reading(tracks, vehicles, arrived, flight_of, sensors, case.vehicle_file.motor_command == "pwm")
    reading = _sampled(reading, slow, derived or few)
    lap("paths")
    tell("replaying the flights")
    look = _physics(reading, library)
    lap("first look")
    known = ()
    for _ in range(LOOKS - 1):
        fits = [f for k, f in look.sets.items() if isinstance(f, SetFit) and not look.feigned & set(k)]
        best = max(fits, key=lambda f: f.score - WORTH_KNOWING * len(f.effects))
        gains = _clear_gains(look.gains, library)
        surprising = best.effects and best.score - look.sets[()].score > WORTH_A_SECOND_LOOK
        if look.rate_loop is None or set(best.effects) == set(known) or not (surprising or gains is not None):
            break
        # The rate controller was read with the nominal physics and gains: once more with what was found.
        tell("looking again with what was found")
        known, pushes = best.effects, None
        if surprising:
            moved, plain = look.replay.predict(best.theta[None]), look.replay.predict(ABSENT[None])
            pushes = [
                np.gradient((m - p)[0, :, :3], track.dt, axis=0)
                for track, m, p in zip(tracks, moved, plain, strict=True)
            ]
        look = _physics(reading, library, pushes, gains, look.sets)
        lap("next look")
    return Evidence(
        case, library, tracks, vehicles, *look[:5], radio, look.rate_loop, look.gains, pose, sensors, seconds
    )  # fmt: skip


def _pose(tracks, flight_of, late: bool):
    """The pose's path, and the tracks with their pose on the gyroscope's clock where it clearly is late."""
    if any(t.quaternion is None for t in tracks):
        return None, tracks
    pose = estimator.read_estimator(tracks, flight_of)
    if late and _late(pose):
        tracks = [estimator.undelayed(t, float(pose.score()[1][0])) for t in tracks]
    return pose, tracks


def _late(pose: LinearPath) -> bool:
    score, delay, _ = pose.score()
    return score > CLEAR_SCORE and abs(delay[0]) > CLEAR_DELAY


def _clear_gains(gains: Gains | None, library: Library):
    """Changes of the rate loop's gains where they are clear, else None."""
    if gains is None or "rate_gains" not in library.effects or not gains.clear:
        return None
    return np.clip(gains.found[0], -0.7, 1.5)


def _sampled(reading: Reading, slow: bool, hidden: bool) -> Reading:
    """What rows of motor commands are: means over the row or single samples, and whether what happens within a row can be
    told at all. Faster logs are averaged onto `slow` rows; what happens is `hidden` where two samples may make a
    row, or where rates are derived from the attitude."""
    tracks, drifts = reading.tracks, reading.sensors.wander > 0.0
    logged = slow and all(t.motors_logged for t in tracks)
    # Rows as slow as this hide every other command of a loop that sends one each 10 ms.
    seldom = max(t.dt for t in tracks) > 1.2 * GRID_PERIOD
    known = reading.arrived is not None and not seldom and not drifts
    at_once = logged and answers_noise(tracks, reading.vehicles) > (AT_ONCE_SELDOM if seldom else AT_ONCE)
    sure = True
    if known and at_once:
        # The log doesn't say which; yaw's loop or the motion does.
        of_all = reading.tracks, reading.vehicles, reading.arrived, reading.flight_of
        loops = {once: firmware.read_rate_loop(*of_all, at_once=once) for once in (False, True)}
        reading = dataclasses.replace(reading, loops=loops)
        told = _obeys_as_sampled(loops[False].gains, loops[True].gains)
        if told is not None:
            at_once = told
        else:
            own = Library(("inertia",))
            mean, single = (_physics(dataclasses.replace(reading, at_once=m), own) for m in (False, True))
            at_once, sure = _looks_sampled(reading.vehicles, mean, single)
    reading = dataclasses.replace(reading, at_once=at_once)
    blind = (reading.at_once and not known) or not sure or drifts or hidden
    late = None if blind or seldom else ROW_DELAY[0 if slow else 1]
    return dataclasses.replace(reading, blind=blind, late=late)


def _obeys_as_sampled(mean: Gains, single: Gains) -> bool | None:
    """Whether yaw's outputs obey the rate loop better as single samples than as means of their rows; None where neither is
    clear, or gains are changed."""
    if min(mean.yaw_left, single.yaw_left) > MOST_LEFT or mean.by_yaw or single.by_yaw:
        return None
    if single.yaw_left < ALIKE_LEFT * mean.yaw_left:
        return True
    return False if mean.yaw_left < APART_LEFT * single.yaw_left else None


def _looks_sampled(vehicles, mean: Look, single: Look) -> tuple[bool, bool]:
    """Whether torques are off as single samples taken for means would have them, and right once they are taken for what
    they are; and whether that is sure. Commands jump where rows begin, so the first motor command of a row is stronger
    than the row's mean, and a vehicle flown by such samples seems heavier to turn."""
    if any(("inertia",) not in look.sets for look in (mean, single)):
        return False, True
    paths = [
        np.asarray(p.motor, float)[: len(t)]
        for p, t in zip(single.replay.physics.paths, single.replay.tracks, strict=True)
    ]
    first, whole = (
        np.concatenate(
            [np.gradient(take(m) @ outputs_of(v), axis=0) for m, v in zip(paths, vehicles, strict=True)]
        )
        for take in (lambda m: m[:, 0], lambda m: m.mean(1))
    )
    kick = ((first * whole).sum(0) / np.maximum((whole**2).sum(0), 1e-12))[:2].mean() - 1.0
    off = [
        np.mean([v for v, _ in list(look.sets["inertia",].parameters()["inertia"].values())[:2]]) - 1.0
        for look in (mean, single)
    ]
    if kick > LEAST_KICK and off[0] > kick and abs(off[1]) < 0.25 * off[0]:
        return True, True
    doubtful = off[0] > HEAVY and abs(off[1]) < 0.5 * off[0]
    return doubtful, not doubtful


def _hidden(card, tracks) -> bool:
    """Whether an effect can't be told from these logs, however large it is."""
    if card.needs and any(getattr(t, card.needs) is None for t in tracks):
        return True
    return card.impossible is not None and any(card.impossible(t.position) for t in tracks)


def _feigned(card, blind: bool, gusts: np.ndarray) -> bool:
    """Whether gusts, or what motors do between two rows, look like an effect."""
    axes = list(card.torque_axes)
    return bool(axes) and bool(blind or gusts[axes].mean() > MOST_GUSTS)


def _physics(reading: Reading, library: Library, pushes=None, gains=None, before=None) -> Look:
    """Look at the physics. `pushes`, `gains`: what an earlier look found; `before`: its sets, to start from."""
    tracks, vehicles, arrived, at_once = reading.tracks, reading.vehicles, reading.arrived, reading.at_once
    rate_loop, read, ticks = None, None, [np.repeat(t.motor[:, None], TICKS, 1) for t in tracks]
    if arrived is not None:
        base = np.zeros(3) if gains is None else gains
        loop = reading.loops.get(at_once) if pushes is None and gains is None else None
        if loop is None:
            loop = firmware.read_rate_loop(
                tracks, vehicles, arrived, reading.flight_of, pushes, base, at_once
            )
        if reading.late is not None:
            found = read_gains(tracks, vehicles, arrived, reading.by_commands, at_once, reading.late)
            loop = firmware.with_gains(loop, found)
        rate_loop, ticks, read = loop.path, loop.ticks, loop.gains
        if at_once:
            tracks = [dataclasses.replace(t, motor=m.mean(1)) for t, m in zip(tracks, ticks, strict=True)]
    feedback, sensors = read_feedback(tracks, vehicles, reading.by_commands), reading.sensors
    replay = make_replay(
        tracks, vehicles, ticks, feedback, reading.numbers, sensors.one_clock, at_once, sensors.wander
    )
    replay, floor, exposure = model_noise(replay, library)
    gusts = gustiness(tracks, feedback, floor)
    replay = dataclasses.replace(replay, gusts=gusts).loosened(
        {
            f"{e} {p}": float(np.hypot(1.0, GUSTY[e, p][0] * gusts[list(GUSTY[e, p][1])].mean() / usual))
            for e, p, usual in replay.numbers
            if (e, p) in GUSTY
        }
    )
    feigned = frozenset(e for e in library.physics if _feigned(CARDS[e], reading.blind, gusts))
    for effect in library.physics:
        if _hidden(CARDS[effect], tracks):
            exposure[effect] = 0.0
    sets = weigh_singles(replay, library, exposure, before)
    if feigned and not reading.blind:
        # A large change leaves more than a straight line takes, which looked like gusts: what is left of its own fit tells.
        for effect in sorted(feigned):
            fit = sets.get((effect,))
            if isinstance(fit, SetFit):
                left = [without_nuisances(replay, c[0], k) for k, c in enumerate(fit.columns)]
                if not _feigned(CARDS[effect], False, gustiness(tracks, feedback, left)):
                    feigned -= {effect}
    return Look(replay, sets, exposure, floor, feigned, rate_loop, read)
