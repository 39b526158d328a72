"""The part of the motors that commands caused, apart from the part that feedback added.

In closed loop the motors answer gusts, noise of the gyroscope and whatever pushes the
body, so a regression on the motors as logged is biased: towards weak motors where they
were logged as single samples, towards any cause that feedback follows. What body-rate
commands caused is free of all that. It serves as an instrument (two-stage least
squares): the first stage here tells the two parts apart; the second lets the feedback
part do what it likes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from openjax.flights.track import Track, smooth
from openjax.gap.model.nuisances import TRIM
from openjax.gap.model.observer import TICKS, respond_to_commands
from openjax.gap.model.prediction import bucket, pad
from openjax.vehicle.rate_controller import mixer

SLOW = 0.06  # s over which commands implied by motors and rates are smoothed
# s: within it, single samples say little about what motors did between them
QUICK = 0.1
COUNT = 57.29577951308232 / 65536.0  # motor command per count and rad/s
BAND = (0.5, 10.0)  # Hz above trims and below filters and single samples
EDGE = 0.3  # s at either end that the filter spoils


@dataclass(frozen=True, eq=False)
class Feedback:
    """Angular accelerations (T, 3) rad/s^2 of one track that parts of what its motors
    do make, through their lag.
    """

    acceleration: np.ndarray
    """By the feedback part."""
    trim: np.ndarray
    """By what they do slowly but for its mean, which holds what pushes the body
    slowly.
    """
    quick: np.ndarray
    """By what they do within QUICK s, whoever caused it."""


def outputs_of(vehicle) -> Float[np.ndarray, "4 3"]:
    """(4, 3) that turns motor commands into the rate controller's outputs, roll, pitch,
    yaw.
    """
    return np.linalg.pinv(np.asarray(mixer(vehicle), float)).T


def in_force(track: Track, arrivals) -> Float[np.ndarray, "rows ticks 4"]:
    """Command (T, TICKS, 4) that rules at each tick of the rate loop."""
    part, rows = arrivals
    out = np.repeat(track.command[rows[:, 0]][:, None], TICKS, 1)
    older = round(part * TICKS)
    out[:, :older] = track.command[rows[:, 1]][:, None]
    return out


def read_feedback(tracks, vehicles, by_commands) -> list[Feedback]:
    """The feedback part of every track's motors. `by_commands`: `caused_by_commands` of
    each.
    """
    commanded_outputs = []
    motor_outputs = []
    for track, vehicle, (motors, _) in zip(tracks, vehicles, by_commands, strict=True):
        outputs = outputs_of(vehicle)
        commanded_outputs.append((motors - motors.mean(0)) @ outputs)
        motor_outputs.append(track.motor @ outputs)
    # First stage: as much of the outputs as is proportional to what commands would have
    # caused, axis by axis. More freedom (a filter) would let the outer loop's answers
    # to gusts in.
    motor_outputs = [m - m.mean(0) for m in motor_outputs]
    power = sum((c * c).sum(0) for c in commanded_outputs)
    common = sum((c * m).sum(0) for c, m in zip(commanded_outputs, motor_outputs, strict=True))
    share = common / np.maximum(power, 1e-12)
    rest = [m - share * c for c, m in zip(commanded_outputs, motor_outputs, strict=True)]
    return [_feedback(r, t, v) for r, t, v in zip(rest, tracks, vehicles, strict=True)]


def _feedback(rest: np.ndarray, track: Track, vehicle) -> Feedback:
    """The effect on one track of outputs (T, 3) that no command explains, and of the motors
    themselves.
    """
    quick_part = rest - smooth(rest, TRIM, track.dt)
    slow_motors = smooth(track.motor, TRIM, track.dt)
    by_outputs = np.asarray(mixer(vehicle), float).T
    return Feedback(
        acceleration=_turning(quick_part @ by_outputs, track, vehicle),
        trim=_turning(slow_motors - track.motor.mean(0), track, vehicle),
        quick=_turning(track.motor - smooth(track.motor, QUICK, track.dt), track, vehicle),
    )


def caused_by_commands(
    track: Track, vehicle, link
) -> tuple[Float[np.ndarray, "rows 4"], Float[np.ndarray, "rows 3"]]:
    """Motor commands (T, 4) and rates (T, 3) that the body-rate commands alone cause;
    `link`: what arrived of them, None where that wasn't read. Where none were logged,
    the nominal controller's law says which ones the motors and rates imply, slowly.
    """
    if track.command is not None:
        commands = track.command if link is None else in_force(track, link).mean(1)
    else:
        gain = np.asarray(vehicle.rate_kp, float) * COUNT
        # of the law outputs = gain (commanded - measured rates)
        implied_rates = track.motor @ outputs_of(vehicle) / gain + track.body_rates
        slow_rates = smooth(implied_rates - implied_rates.mean(0), SLOW, track.dt)
        commands = np.concatenate([track.motor.mean(1)[:, None], slow_rates], 1)
    motors, rates = respond_to_commands(
        vehicle, pad(commands, bucket(len(track))), np.float32(track.dt)
    )
    return np.asarray(motors, float)[: len(track)], np.asarray(rates, float)[: len(track)]


def _turning(motors: np.ndarray, track: Track, vehicle) -> np.ndarray:
    """Angular acceleration (T, 3) that changes of the motor commands (T, 4) make,
    through the motors' lag.
    """
    # a command is a share of thrust, so the lag may act on thrust instead of speed: to
    # first order of small changes both are the same
    blend = -np.expm1(-track.dt / float(vehicle.motor_time_constant))
    thrust = lfilter([blend], [1.0, blend - 1.0], motors, axis=0)
    thrust *= float(vehicle.thrust_constant * vehicle.max_rotor_speed**2)
    place = np.asarray(vehicle.rotor_position, float)
    spin = np.asarray(vehicle.rotor_spin, float)
    ratio = float(vehicle.torque_constant / vehicle.thrust_constant)
    torque = np.stack([thrust @ place[:, 1], -thrust @ place[:, 0], ratio * (thrust @ spin)], 1)
    return torque / np.asarray(vehicle.inertia, float)
