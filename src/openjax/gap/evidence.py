"""Everything that a case's flights say about causes, before any decision: scores of sets, path by path."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.flights.track import Track, tracks_of
from openjax.gap import estimator, firmware
from openjax.gap.firmware import Radio
from openjax.gap.hypotheses import SetFit, model_noise, weigh_singles
from openjax.gap.kinematics import Kinematics, corrected, read_kinematics
from openjax.gap.library import ABSENT, CARDS, NUISANCES, PWM_NUISANCES, Library
from openjax.gap.linear_path import LinearPath
from openjax.gap.observer import TICKS
from openjax.gap.replay import Replay, make_replay

CLEAR_DELAY = 0.002  # s of pose delay above which the pose is moved before the physics is read
CLEAR_SCORE = 3.0  # nats, likewise
CLEAR_GAINS = 20.0  # nats of the rate loop's path from which its gains are used to read it again
LOOKS = 2  # at most
WORTH_KNOWING = 15.0  # nats that an effect must add to be taken as known in the next look
WORTH_A_SECOND_LOOK = 30.0  # nats of the best set above none
RADIO_COST = 15.0  # nats that a radio effect must gain before the rate loop is read with it


@dataclass(eq=False)
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
    radio: Radio | None
    rate_loop: LinearPath | None
    pose: LinearPath | None
    sensors: Kinematics
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def nothing(self) -> SetFit:
        return self.sets[()]


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
    lap("paths")
    tell("replaying the flights")
    numbers = PWM_NUISANCES if case.vehicle_file.motor_command == "pwm" else NUISANCES
    found = _physics(tracks, vehicles, arrived, flight_of, library, numbers, sensors.one_clock)
    lap("first look")
    known = ()
    for _ in range(LOOKS - 1):
        fits = [f for f in found[1].values() if isinstance(f, SetFit)]
        best = max(fits, key=lambda f: f.score - WORTH_KNOWING * len(f.effects))
        gains = _clear_gains(found[4], library)
        surprising = best.effects and best.score - found[1][()].score > WORTH_A_SECOND_LOOK
        if found[4] is None or set(best.effects) == set(known) or not (surprising or gains is not None):
            break
        # The rate controller was read with the nominal physics and gains: once more with what was found.
        tell("looking again with what was found")
        known, pushes = best.effects, None
        if surprising:
            moved, plain = found[0].predict(best.theta[None]), found[0].predict(ABSENT[None])
            pushes = [
                np.gradient((m - p)[0, :, :3], track.dt, axis=0)
                for track, m, p in zip(tracks, moved, plain, strict=True)
            ]
        found = _physics(
            tracks, vehicles, arrived, flight_of, library, numbers, sensors.one_clock, pushes, gains, found[1]
        )
        lap("next look")
    replay, sets, exposure, floor, rate_loop = found
    return Evidence(
        case,
        library,
        tracks,
        vehicles,
        replay,
        sets,
        exposure,
        floor,
        radio,
        rate_loop,
        pose,
        sensors,
        seconds,
    )


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


def _clear_gains(rate_loop: LinearPath | None, library: Library):
    """Changes of the rate loop's gains where they are clear, else None."""
    if rate_loop is None or "rate_gains" not in library.effects:
        return None
    score, theta, _ = rate_loop.score()
    return np.clip(theta[:3], -0.7, 1.5) if score > CLEAR_GAINS else None


def _physics(
    tracks, vehicles, arrived, flight_of, library, numbers, one_clock, pushes=None, gains=None, before=None
):
    """Replay, scores of the sets, exposure, floor residuals and the rate loop's path."""
    rate_loop, ticks = None, [np.repeat(t.motor[:, None], TICKS, 1) for t in tracks]
    if arrived is not None:
        base = np.zeros(3) if gains is None else gains
        loop = firmware.read_rate_loop(tracks, vehicles, arrived, flight_of, pushes, base)
        rate_loop, ticks = loop.path, loop.ticks
    links = arrived if arrived is not None else [None] * len(tracks)
    back = [firmware.fed_back(t, v, link) for t, v, link in zip(tracks, vehicles, links, strict=True)]
    replay = make_replay(tracks, vehicles, ticks, back, numbers, one_clock)
    floor, exposure = model_noise(replay, library)
    for effect in library.physics:
        needs = CARDS[effect].needs
        if needs and any(getattr(t, needs) is None for t in tracks):
            exposure[effect] = 0.0
    return replay, weigh_singles(replay, library, exposure, before), exposure, floor, rate_loop
