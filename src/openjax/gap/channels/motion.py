"""The motion: motors to body rates, velocity and specific force. What each physics
effect alone explains of it.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from openjax.errors import UserError
from openjax.flights.clocks import ROWS
from openjax.flights.flight import Case
from openjax.flights.grid import GRID_PERIOD
from openjax.flights.kinematics import Kinematics
from openjax.flights.track import Track
from openjax.gap.channels.instruments import caused_by_commands, read_feedback
from openjax.gap.channels.rate_loop import ROW_DELAY, RateLoop
from openjax.gap.model.baseline import Baseline, with_days
from openjax.gap.model.hypotheses import (
    UNEXPOSED,
    SetFit,
    fit_set,
    fit_singles,
    in_order,
    model_noise,
)
from openjax.gap.model.library import CARDS, Library, numbers_of
from openjax.gap.model.observer import TICKS
from openjax.gap.model.prediction import RATES
from openjax.gap.model.replay import Replay, make_replay
from openjax.gap.model.wakes import Gusts, as_loud_as, fit_wake, read_gusts
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.effects.effect import Need

# rows of a log in one of the grid's: if fewer are samples, their mean isn't what five
# ticks of the loop did
FEW_ROWS = 2.4
# grid periods: rows as slow hide every other command of a loop that sends one each 10
# ms
SLOW_ROWS = 1.2


@dataclass(frozen=True, eq=False)
class Reading:
    """A way of reading the rows of a case."""

    library: Library
    tracks: list[Track]
    vehicles: list
    arrivals: list | None
    """The commands that the link let through; None without commands."""
    sensors: Kinematics
    pwm: bool
    """True if motors are duty cycles."""
    at_once: bool
    """True if a row's motors are one sample, as the vehicle file's [log] says by
    motor_rows = "sample".
    """
    blind: bool
    """True if it is unknown what motors do within a row."""
    late: float | None
    """By how much motors may be off against the gyroscope (s); None where that isn't
    known.
    """
    baseline: Baseline | None = None
    """The vehicle while nothing acts; None if unknown."""
    reference: bool = False
    """True if these flights are to tell that."""

    @property
    def numbers(self):
        """The vehicle's numbers that are free in every hypothesis, as
        `library.numbers_of` has them: how far they are usually off depends on how
        motors were logged.
        """
        situation = "always"
        if self.pwm:
            situation = "duty_cycles"
        elif self.blind:
            situation = "samples"
        usual = numbers_of(situation, self.vehicles[0])
        if self.reference:
            return with_days(usual, self.vehicles[0])
        if self.baseline is None:
            return usual
        reference_numbers = self.baseline.numbers
        keys = {number[:2] for number in reference_numbers}
        return (*reference_numbers, *(number for number in usual if number[:2] not in keys))

    def lacks(self, need: Need) -> bool:
        """True if what an effect can't be told without isn't known of one of the flights."""
        if need == "thrust_map":
            # of duty cycles without a reference, or without the voltage that changes it
            unknown = self.baseline is None or self.lacks("voltage")
            return self.pwm and unknown and not self.reference
        if need == "force":
            # Torques alone tell a weaker push from nothing: heavier moments of inertia
            # look the same.
            return any(t.velocity is None and t.specific_force is None for t in self.tracks)
        return any(getattr(t, need) is None for t in self.tracks)

    @property
    def firmware_tracks(self) -> list[Track]:
        """The tracks as the firmware hears them: its gyroscope as it is, whatever was
        found to be its gain.
        """
        gain = self.sensors.gain
        return [dataclasses.replace(t, body_rates=t.body_rates * gain) for t in self.tracks]

    @cached_property
    def by_commands(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """`caused_by_commands` of each track."""
        links = self.arrivals if self.arrivals is not None else [None] * len(self.tracks)
        each = zip(self.tracks, self.vehicles, links, strict=True)
        return [caused_by_commands(track, vehicle, link) for track, vehicle, link in each]


def motor_rows(case: Case) -> str:
    """The meaning of a row's motor commands, one of `clocks.ROWS`. Raises UserError for anything
    else.
    """
    rows = case.vehicle_file.log.get("motor_rows", ROWS[0])
    if rows not in ROWS:
        raise UserError(
            f"{case.name}: vehicle.toml has [log] motor_rows = {rows!r}; it must be one of "
            f"{', '.join(ROWS)}"
        )
    return rows


def make_reading(
    case: Case, library: Library, tracks, vehicles, arrivals, sensors: Kinematics
) -> Reading:
    """Choose how the rows of a case are read."""
    shortest = min(f.row_period for f in case.flights)
    slow = shortest > 0.8 * GRID_PERIOD  # faster logs are averaged
    seldom = max(t.dt for t in tracks) > SLOW_ROWS * GRID_PERIOD
    at_once = motor_rows(case) == "sample" and slow and all(t.motors_logged for t in tracks)
    # said, not assumed
    means = case.vehicle_file.log.get("motor_rows", "").startswith("mean")
    few = not means and not slow and GRID_PERIOD / shortest < FEW_ROWS
    ticks_are_hidden = few or any(f.body_rates_derived for f in case.flights)
    blind = ticks_are_hidden or (at_once and (arrivals is None or seldom))
    late = None if blind or seldom else ROW_DELAY[0 if slow else 1]
    pwm = case.vehicle_file.motor.command == "pwm"
    return Reading(
        library=library,
        tracks=tracks,
        vehicles=vehicles,
        arrivals=arrivals,
        sensors=sensors,
        pwm=pwm,
        at_once=at_once,
        blind=blind,
        late=late,
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """The flights' evidence on the effects between motors and motion."""

    replay: Replay
    library: Library
    exposure: dict[str, float]
    """{effect: nats that it would leave at its usual size}; 0 where it can't be
    told.
    """
    gusts: Gusts | None = None
    """Under other vehicles, if these gust beyond doubt."""
    elsewhere: frozenset[str] = frozenset()
    """Effects that other estimators tell."""

    @cached_property
    def nothing(self) -> SetFit:
        """The fit of no effect."""
        return fit_set(self.replay, ())

    @cached_property
    def base(self) -> SetFit:
        """The fit of what other estimators named, and nothing else."""
        return (
            fit_set(self.replay, in_order(self.replay.other_sizes))
            if self.replay.other_sizes
            else self.nothing
        )

    @cached_property
    def singles(self) -> dict[str, SetFit]:
        """The fit of each effect that the replay tells, beside those of `base`."""
        visible = [
            e
            for e in self.library.physics
            if e not in self.elsewhere and self.exposure[e] >= UNEXPOSED
        ]
        return fit_singles(self.replay, visible)

    def with_sizes(
        self, effects: Mapping[str, tuple[np.ndarray, np.ndarray]], elsewhere
    ) -> "Motion":
        """The motion with the mean and covariance of `effects` by other estimators,
        which tell all of `elsewhere`.
        """
        replay = dataclasses.replace(self.replay, other_sizes=dict(effects))
        return dataclasses.replace(self, replay=replay, elsewhere=frozenset(elsewhere))


def read_motion(reading: Reading, loop: RateLoop | None) -> Motion:
    """Replay the flights; `loop` knows what the motors did within a row."""
    tracks = reading.tracks
    sensors = reading.sensors
    library = reading.library
    ticks = [np.repeat(t.motor[:, None], TICKS, 1) for t in tracks] if loop is None else loop.ticks
    if loop is not None and reading.at_once:
        # single samples: what the ticks did on the mean is nearer to what drove the row
        both = zip(tracks, ticks, strict=True)
        tracks = [dataclasses.replace(track, motor=motor.mean(1)) for track, motor in both]
    feedback = read_feedback(tracks, reading.vehicles, reading.by_commands)
    clocks = sensors.one_clock, reading.at_once
    replay = make_replay(
        tracks, reading.vehicles, ticks, feedback, reading.numbers, clocks, reading.baseline
    )
    replay, exposure = model_noise(replay, library)
    exposure |= {e: 0.0 for e in library.physics if _is_hidden(CARDS[e], reading)}
    if not sensors.motor_clock:
        exposure |= {e: 0.0 for e in library.physics if _is_lag(e)}
    if not replay.usable[RATES].any():
        # Rotors that only differ from each other turn the vehicle. The little force that
        # comes of it follows slow turns, and would have rotors differ by 40 % whose
        # motors are within 4 %.
        exposure |= {e: 0.0 for e in library.physics if CARDS[e].balanced}
    return _beside_others(Motion(replay, library, exposure))


def _beside_others(motion: Motion) -> Motion:
    """The motion with what other vehicles' wakes do beside a push at once."""
    if not any(len(track.neighbours) for track in motion.replay.tracks):
        return motion
    visible_effects = [
        e for e in motion.library.physics if CARDS[e].of_others and motion.exposure[e] >= UNEXPOSED
    ]
    fit = fit_wake(motion.replay, visible_effects[0]) if visible_effects else motion.nothing
    gusts = read_gusts(fit)
    # nuisances are as around nothing again
    replay = dataclasses.replace(motion.replay, physics=fit.replay.physics)
    if not gusts.louder:
        return dataclasses.replace(motion, replay=replay)
    replay, gusts = as_loud_as(gusts, replay, visible_effects)
    return dataclasses.replace(motion, replay=replay, gusts=gusts)


def _is_lag(effect: str) -> bool:
    """True if an effect is a time by which something comes later."""
    return any(EFFECTS[effect].parameters[p.name].unit == "s" for p in CARDS[effect].fitted)


def _is_hidden(card, reading: Reading) -> bool:
    """True if an effect can't be told from these logs, however large it is: its channel is missing,
    or it looks like a nuisance, what motors do unseen or the map from duty cycles to thrust.
    """
    if any(map(reading.lacks, card.needs)) or (reading.blind and card.torque_axes):
        return True
    # of motors that were made of the commands torques tell nothing
    if reading.lacks("force") and not all(t.motors_logged for t in reading.tracks):
        return True
    return card.impossible is not None and any(
        t.ceiling is None and card.impossible(t.position) for t in reading.tracks
    )
