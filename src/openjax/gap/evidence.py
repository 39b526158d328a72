"""Everything that a case's flights say about causes, before any decision, channel by
channel.
"""

from dataclasses import dataclass, replace

import numpy as np

from openjax.errors import TooLittle
from openjax.flights.clocks import (
    case_on_gyroscope_clock,
    on_gyroscope_clock,
    read_command_clock,
    read_motor_clock,
)
from openjax.flights.flight import Case
from openjax.flights.grid import tracks_of
from openjax.flights.kinematics import Kinematics, correct, read_kinematics
from openjax.flights.track import Track, without_delay
from openjax.gap.channels import Channel
from openjax.gap.channels.motion import Motion, make_reading, motor_rows, read_motion
from openjax.gap.channels.pose import Pose, read_pose
from openjax.gap.channels.radio import read_radio
from openjax.gap.channels.rate_loop import read_rate_loop, with_motors
from openjax.gap.decision import DECISION
from openjax.gap.identification.estimates import GAINS, TORQUES
from openjax.gap.identification.quantities import Identification, identify
from openjax.gap.identification.torque_causes import Torques, torques_of
from openjax.gap.model.baseline import Baseline
from openjax.gap.model.library import CARDS, Library, places
from openjax.gap.model.nuisances import UNKNOWN_GAIN
from openjax.gap.model.replay import Replay


@dataclass(frozen=True, eq=False)
class Evidence:
    """The data that were read from a case."""

    case: Case
    library: Library
    tracks: list[Track]
    """The stretches of all flights."""
    vehicles: list
    """The nominal vehicle of each."""
    sensors: Kinematics
    channels: tuple[Channel, ...]
    """Of pose, radio and rate loop those that were logged."""
    motion: Motion
    """Of the physics."""
    baseline: Baseline | None = None
    """The vehicle while nothing acts; None if unknown."""
    identification: Identification | None = None
    """The response of the torques in closed loop."""
    torques: Torques | None = None
    """Its evidence on causes; None if it isn't trusted."""

    @property
    def replay(self) -> Replay:
        """Of the motion."""
        return self.motion.replay

    @property
    def charge_unknown(self) -> bool:
        """True if a battery's charge acts unseen: motors are duty cycles, and no voltage was
        logged.
        """
        silent = any(t.voltage is None for t in self.tracks)
        return silent and self.pwm

    @property
    def pwm(self) -> bool:
        """True if motor commands are duty cycles."""
        return self.case.vehicle_file.motor.command == "pwm"

    @property
    def silent(self) -> frozenset[str]:
        """Effects of the library that only the torques tell, at least at their usual
        size, and that these don't.
        """
        untestable = {*GAINS} if self.torques is None else self.torques.untestable
        return frozenset(untestable) & frozenset(self.library.physics)

    def gust_nats(self, theta: np.ndarray) -> float:
        """Nats by which gusts under other vehicles speak for parameters theta (P,)."""
        gusts = self.motion.gusts
        wakes = [places((e,)) for e in self.library.physics if CARDS[e].of_others]
        acts = any((theta[place] != self.replay.absent[place]).any() for place in wakes)
        return gusts.nats if gusts is not None and acts else 0.0

    def with_torques(self, torques: Torques | None) -> "Evidence":
        """The evidence with what the torques tell, in the replay as well."""
        elsewhere = {*GAINS} if torques is None else {*TORQUES}
        sizes = {} if torques is None else torques.parameters
        return replace(self, torques=torques, motion=self.motion.with_sizes(sizes, elsewhere))


def gather(
    case: Case, library: Library, progress=None, baseline: Baseline | None = None, reference=False
) -> Evidence:
    """Read a case by all its channels. `baseline`: what the vehicle is like while
    nothing acts; `reference`: these flights are to tell that. Raises TooLittle where no
    stretch of flight is long enough.
    """
    tell = progress or (lambda text: None)
    if case.vehicle_file.mass_weighed:
        # what was weighed can't be wrong
        library = Library(tuple(e for e in library.effects if not CARDS[e].weighed))
    tell("reading the channels of the log")
    tracks, vehicles = _tracks(case)
    # in this order: which clock motors are put on depends on whether pose and gyroscope
    # share one
    tracks, pose, sensors = _sensors(tracks, library)
    if any(f.body_rates_derived for f in case.flights):
        pose = None  # rates that were made of the attitude agree with it
    tracks, sensors = _motors(case, tracks, vehicles, sensors)
    tracks = [with_motors(t, v) for t, v in zip(tracks, vehicles, strict=True)]
    # the loop after the radio: it has to know when commands arrive
    radio = None
    if all(t.command is not None and t.motors_logged for t in tracks):
        radio = read_radio(tracks, library, motor_rows(case) == "sample")
    arrivals = None if radio is None else radio.arrivals
    reading = make_reading(case, library, tracks, vehicles, arrivals, sensors)
    reading = replace(reading, baseline=baseline, reference=reference)
    loop = None if radio is None else read_rate_loop(reading)
    tell("replaying the flights")
    channels = tuple(c for c in (pose, radio, loop) if c is not None)
    motion = read_motion(reading, loop)
    if motion.gusts is not None:
        finding = {"gusts under others": motion.gusts.in_words()}
        sensors = replace(sensors, findings=sensors.findings | finding)
    evidence = Evidence(case, library, tracks, vehicles, sensors, channels, motion, baseline)
    return evidence.with_torques(None)


def with_identification(evidence: Evidence) -> Evidence:
    """The evidence with what the vehicle does. Motors that a log has late are no lag of
    the motors, and a gyroscope that reads too much is no lighter body: its gain is the
    reference's where there is one, so that both are read alike.
    """
    sensors = evidence.sensors
    reference = None if evidence.baseline is None else evidence.baseline.identification
    gain = sensors.gain if reference is None else reference.gyroscope_gain
    in_time = case_on_gyroscope_clock(evidence.case, sensors.motors_late)
    gain_error = 0.0 if all(t.logs_attitude for t in evidence.tracks) else UNKNOWN_GAIN
    identification = identify(
        with_gyroscope_gain(in_time, gain), sensors.one_clock and sensors.motor_clock, gain_error
    )
    if identification is None:
        return evidence
    identification = replace(identification, gyroscope_gain=gain)
    evidence = replace(evidence, identification=identification)
    absent = evidence.replay.absent
    vehicle = evidence.vehicles[0]
    torques = torques_of(identification, evidence.baseline, vehicle, evidence.pwm, absent)
    if torques is not None:
        exposure = evidence.motion.exposure
        visible = (e for e in TORQUES if exposure.get(e, 0.0) > 0.0)
        torques = replace(torques, effects=tuple(visible))
    return evidence.with_torques(torques)


def with_gyroscope_gain(case: Case, gain: float) -> Case:
    """The case with body rates as a gyroscope without that gain reads them."""

    def without_gain(flight):
        if flight.body_rates is None or flight.body_rates_derived:
            return flight
        return replace(flight, body_rates=flight.body_rates / gain)

    return replace(case, flights=tuple(without_gain(f) for f in case.flights))


def _motors(case: Case, tracks, vehicles, sensors: Kinematics) -> tuple[list[Track], Kinematics]:
    """The tracks with motor commands when they act, and what the sensors say with what
    the motors' clock says.
    """
    row = min(f.row_period for f in case.flights)
    if apart := read_command_clock(tracks, row):
        sensors = replace(sensors, findings=sensors.findings | {"command clock": apart})
        # commands of another clock can't say what the motors should have done; without
        # motors they are all there is
        tracks = [t if t.motor is None else replace(t, command=None) for t in tracks]
    clock = read_motor_clock(tracks, vehicles, row, motor_rows(case))
    if not sensors.one_clock:
        # Forces are compared with the pose: motors are put on its clock.
        pose = read_motor_clock(tracks, vehicles, row, motor_rows(case), gyroscope=False)
        clock = replace(pose, one_clock=pose.one_clock and clock.one_clock)
    findings = sensors.findings | clock.findings
    sensors = replace(
        sensors, findings=findings, motor_clock=clock.one_clock, motors_late=clock.late
    )
    return [on_gyroscope_clock(t, clock) for t in tracks], sensors


def _tracks(case: Case) -> tuple[list[Track], list]:
    """The stretches of all flights and their nominal vehicles."""
    tracks = [t for t in tracks_of(case) if t.motor is not None or t.command is not None]
    if not tracks:
        raise TooLittle(
            f"{case.name}: no flight has 2 s without a gap, with body rates and commands or motors"
        )
    flights = {f.name: f for f in case.flights}
    return tracks, [case.vehicle_of(flights[t.name.split("#")[0]]) for t in tracks]


def _sensors(tracks: list[Track], library: Library) -> tuple[list[Track], Pose | None, Kinematics]:
    """The tracks as sensors that agree would have them, the pose's channel, and what
    the sensors say of each other.
    """
    pose = read_pose(tracks, library)
    moves = pose is not None and pose.names and pose.late
    original = tracks
    if moves:
        tracks = [without_delay(t, pose.fit.value) for t in original]
    sensors = read_kinematics(tracks, DECISION)
    if moves and not sensors.one_clock:  # then it isn't the pose's delay that was found
        tracks = original
        sensors = read_kinematics(tracks, DECISION)
    tracks = [correct(t, sensors) for t in tracks]
    if pose is not None and not moves:
        pose = read_pose(tracks, library)
    return tracks, pose if sensors.one_clock else None, sensors
