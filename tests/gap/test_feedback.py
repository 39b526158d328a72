"""The rate loop's gains and the motors' sampling, read from a loop written out in
NumPy.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.flights.track import Track
from openjax.gap.channels.instruments import COUNT, caused_by_commands, outputs_of, read_feedback
from openjax.gap.channels.rate_loop import RateLoop, observe_track, read_rate_loop
from openjax.gap.model.library import Library
from openjax.vehicle import load_vehicle
from openjax.vehicle.rate_controller import mixer

ROWS = 900
DT = 0.01
TICKS = 5


def flown(seed, p=1.0, gust=0.0, noise=0.005, sampled=False, commands=1.0, pull=0.0):
    """A flight in which commands step every .3 s: rigid body, motors' lag, and the
    firmware's loop at 500 Hz with a P of `p` times the nominal one, gusts of `gust`
    rad/s^2, `pull` rad/s^2 of pitch all the time and `noise` rad/s in the gyroscope;
    `commands` times as large.
    """
    vehicle = load_vehicle()
    rng = np.random.default_rng(seed)
    gains = [
        np.asarray(getattr(vehicle, n), float) * COUNT for n in ("rate_kp", "rate_ki", "rate_kd")
    ]
    mix = np.asarray(mixer(vehicle), float)
    h = DT / TICKS
    reach = np.asarray(vehicle.rotor_position, float)
    arms = np.stack([reach[:, 1], -reach[:, 0]])
    arms = np.concatenate(
        [
            arms,
            float(vehicle.torque_constant / vehicle.thrust_constant)
            * np.asarray(vehicle.rotor_spin, float)[None],
        ]
    )
    turning = (
        arms
        * float(vehicle.thrust_constant * vehicle.max_rotor_speed**2)
        / np.asarray(vehicle.inertia, float)[:, None]
    )
    command = np.repeat(0.6 * rng.standard_normal((ROWS // 30, 3)), 30, axis=0)
    command += 0.1 * rng.standard_normal((ROWS, 3))  # a position controller's own noise
    command *= commands
    rates = np.zeros(3)
    integral = np.zeros(3)
    thrust = np.full(4, 0.6)
    before = np.zeros(3)
    push = np.zeros(3)
    out = {"rates": [], "motor": []}
    for row in range(ROWS):
        motors = []
        for tick in range(TICKS):
            seen = rates + noise * rng.standard_normal(3)
            if tick == 0:
                out["rates"].append(seen)
            error = command[row] - seen
            integral = integral + h * error
            wanted = p * gains[0] * error + gains[1] * integral - gains[2] * (seen - before) / h
            before = seen
            motors.append(np.clip(0.6 + mix @ wanted, 0.0, 1.0))
            thrust = thrust + (1.0 - np.exp(-h / float(vehicle.motor_time_constant))) * (
                motors[-1] - thrust
            )
            push = 0.98 * push + 0.2 * gust * rng.standard_normal(3)
            rates = rates + h * (turning @ thrust + push + [0.0, pull, 0.0])
        out["motor"].append(motors[0] if sampled else np.mean(motors, 0))
    sent = np.concatenate([np.full((ROWS, 1), 0.6), command], 1)
    track = Track(
        name="flight", flight="flight", dt=DT, time=DT * np.arange(ROWS), position=None, quaternion=None,
        velocity=None, body_rates=np.array(out["rates"]), specific_force=None, command=sent,
        motor=np.array(out["motor"]), voltage=None, neighbours=np.zeros((0, ROWS, 3)),
    )  # fmt: skip
    rows = np.arange(ROWS)
    return track, vehicle, (0.0, np.stack([rows, np.maximum(rows - 1, 0)], 1))


@pytest.mark.parametrize(
    ("p", "sampled"), [(1.0, False), (1.4, False), (0.7, False), (1.0, True), (1.4, True)]
)
def test_gains_are_what_the_loop_has_whatever_gusts_and_noise_do(p, sampled):
    found = read([flown(seed, p, gust=5.0, sampled=sampled) for seed in range(3)], sampled)
    change = found.change
    error = found.error
    assert change[0] == pytest.approx(p - 1.0, abs=2.0 * error[0])
    assert change[3] == pytest.approx(p - 1.0, abs=0.03)
    assert bool(loop(change, error, p - 1.0).acting()) == (p != 1.0)


def test_ticks_hold_against_a_pull_as_the_samples_of_the_motors_do():
    """Not only the first tick of a row, as the log has it: a loop that doesn't know what
    pulls, such as an offset of the centre of mass, lets go of a quarter of it until the
    row ends.
    """
    track, vehicle, link = flown(1, pull=4.0, sampled=True)
    _, ticks = observe_track(track, vehicle, link, at_once=True)
    pitch = -np.asarray(vehicle.rotor_position, float)[:, 0]
    held, logged = (m[ROWS // 9 :].mean(0) @ pitch for m in (ticks.mean(1), track.motor))
    assert held == pytest.approx(logged, rel=0.05)


def test_a_vehicle_that_hardly_turns_says_nothing_of_its_gains():
    found = read([flown(seed, commands=0.05, noise=0.02) for seed in range(3)])
    assert found.undetectable() == ["rate_gains"] and not found.acting()


def read(flights, sampled=False) -> RateLoop:
    """The rate loop of flights as `flown` gives them."""
    tracks, vehicles, links = zip(*flights, strict=True)
    commanded = [caused_by_commands(*f) for f in flights]
    reading = SimpleNamespace(
        firmware_tracks=tracks,
        vehicles=vehicles,
        arrivals=links,
        by_commands=commanded,
        at_once=sampled,
        late=0.0005,
        library=Library(),
    )
    return read_rate_loop(reading)


def test_calm_flights_leave_all_of_the_motors_to_feedback():
    """What commands caused is told apart: with gusts alone, the feedback part is nearly
    all that the motors did.
    """
    track, vehicle, link = flown(1, gust=20.0)
    (still,) = read_feedback([track], [vehicle], [caused_by_commands(track, vehicle, link)])
    quiet, _, _ = flown(1)
    (driven,) = read_feedback([quiet], [vehicle], [caused_by_commands(quiet, vehicle, link)])
    assert still.acceleration.std() > 5.0 * driven.acceleration.std()
    made = (quiet.motor - quiet.motor.mean(0)) @ outputs_of(vehicle)
    assert made.std() > 0.01


def loop(change, error, shown=0.4):
    """A rate loop whose motors show `shown` more of p, whatever was read."""
    tied = np.random.default_rng(0).standard_normal((3, 200, 3))
    outputs = np.concatenate([shown * tied[:1], tied])
    return RateLoop(np.array(change), np.array(error), [outputs], [], ("rate_gains",))


def test_gains_of_all_axes_are_one_reading_that_covers_what_they_disagree_by():
    value, error = loop([0.4, 0, 0, 0.4, 0, 0], [0.05] * 6).gain
    assert value[0] == pytest.approx(0.4) and error[0] == pytest.approx(0.05 / np.sqrt(2.0))
    apart = loop([0.4, 0, 0, -0.4, 0, 0], [0.05] * 6)
    assert apart.gain[1][0] > 0.35
    assert loop([0.4, 0, 0, 0.0, 0, 0], [0.05] * 3 + [np.inf] * 3).acting()
    # forms are wrong by as much
    assert not loop([0.04, 0, 0, 0.04, 0, 0], [0.01] * 6).acting()
    assert not loop(
        [0.4, 0, 0, 0.4, 0, 0], [0.05] * 6, shown=0.01
    ).named_effects()  # the motors don't follow


def test_without_enough_flight_gains_cannot_be_told():
    assert loop(np.zeros(6), np.full(6, np.inf)).undetectable() == ["rate_gains"]
