"""The physics along several tracks at once against one track and one parameter vector
at a time.
"""

import dataclasses

import numpy as np
import pytest

from openjax.flights.track import Track
from openjax.gap.channels.instruments import Feedback
from openjax.gap.model.library import ABSENT, PLACE, STEP
from openjax.gap.model.observer import TICKS
from openjax.gap.model.prediction import LANES, RATES, make_physics
from openjax.gap.model.replay import make_replay
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS
from tests.vehicle.typical import typical


def track_of(rows: int, seed: int) -> Track:
    rng = np.random.default_rng(seed)
    return Track(
        name="flight", flight="flight", dt=0.01, time=0.01 * np.arange(rows), position=rng.uniform(0.2, 0.8, (rows, 3)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)), velocity=rng.standard_normal((rows, 3)),
        body_rates=rng.standard_normal((rows, 3)), specific_force=None, command=None,
        motor=rng.uniform(0.4, 0.8, (rows, 4)), voltage=None, neighbours=np.zeros((0, rows, 3)),
    )  # fmt: skip


def test_tracks_and_parameters_that_share_a_call_are_not_mixed_up():
    light = load_vehicle()
    tracks = [track_of(200 + 10 * k, k) for k in range(3)]
    vehicles = [light, light.replace(mass=0.9 * light.mass), light]
    ticks = [np.repeat(t.motor[:, None], TICKS, 1) for t in tracks]
    theta = ABSENT + 5.0 * STEP * np.random.default_rng(9).uniform(
        0.0, 1.0, (LANES // 2, len(ABSENT))
    )
    together = make_physics(tracks, vehicles, ticks).predict(theta)
    for number, track in enumerate(tracks):
        alone = make_physics(
            tracks[number : number + 1], vehicles[number : number + 1], ticks[number : number + 1]
        )
        for k, vector in enumerate(theta):
            np.testing.assert_array_equal(together[number][k], alone.predict(vector[None])[0][0])
        assert together[number].shape == (len(theta), len(track), 9)
    assert len({channels[0, -1, 5] for channels in together}) == 3
    assert len(np.unique(together[0][:, -1, 5])) == len(theta)


def below(height: float, ceiling: float | None) -> np.ndarray:
    """Specific force (T, 3) of a vehicle at a height, m, with downwash of one .4 m
    above.
    """
    track = track_of(200, 0)
    track.position[:] = [0.0, 0.0, height]
    over = np.tile([[[0.0, 0.0, height + 0.4]]], (1, 200, 1))
    track = dataclasses.replace(track, neighbours=over, ceiling=ceiling)
    theta = ABSENT.copy()
    for (effect, parameter), place in PLACE.items():
        if effect in ("downwash", "ceiling_effect"):
            theta[place] = typical(EFFECTS[effect])[parameter]
    ticks = [np.repeat(track.motor[:, None], TICKS, 1)]
    return make_physics([track], [load_vehicle()], ticks).predict(theta[None])[0][0, :, 6:]


@pytest.mark.parametrize("height", [1.25, 1.6, 3.0])
def test_a_room_higher_than_the_arena_has_the_wakes_and_the_ceiling_that_it_has(height):
    """Only a ceiling that somebody measured clips a height, and those who fly along
    likewise.
    """
    free = below(0.5, 50.0)
    np.testing.assert_allclose(below(height, None), free, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(below(height, height + 0.5), below(0.5, 1.0), rtol=1e-4, atol=1e-4)
    assert np.abs(below(height, height + 0.5) - free).max() > 0.01


def test_a_wrong_moment_of_inertia_turns_nothing_that_motors_hold_against():
    """Motors that always pull one way hold against something, known or not: their sum
    is zero, and nothing to be scaled.
    """
    track = track_of(300, 1)
    vehicle = load_vehicle()
    # against a centre of mass to the right, or whatever it is
    track.motor[:, :2] += 0.1
    still = np.zeros((300, 3))
    numbers = (("inertia", "xx", 0.3),)
    ticks = [np.repeat(track.motor[:, None], TICKS, 1)]
    replay = make_replay([track], [vehicle], ticks, [Feedback(*[still] * 3)], numbers)
    assert abs(replay.nominal[0][-1, 0]) > 1.0
    assert abs(replay.nuisances[0][0, -1, RATES]).max() < 1e-6
    aside = ABSENT.copy()
    aside[PLACE["com_offset", "y"]] = 0.001
    around = replay.around(aside)
    steps = np.array([0.0, 1e-2])
    heavier = np.repeat(aside[None], 2, 0)
    heavier[:, PLACE["inertia", "xx"]] += steps
    light, heavy = replay.predict(heavier)[0][:, :, 0]
    np.testing.assert_allclose(
        around.nuisances[0][0, 1:, 0] / 0.3, (heavy - light)[1:] / 1e-2, rtol=0.05
    )


def test_a_propeller_that_spins_up_turns_the_body_by_its_angular_momentum():
    """Whatever the motors' lag does on the way: the sum over time is what the rotors'
    speeds changed by.
    """
    track = track_of(300, 1)
    vehicle = load_vehicle()
    harder = np.arange(300)[:, None] >= 150
    track.motor[:] = np.where(harder, 0.4 + 0.2 * np.array([1.0, 0.0, 1.0, 0.0]), 0.4)
    with_propellers = np.repeat(ABSENT[None], 2, 0)
    with_propellers[1, -2] = 0.002
    physics = make_physics([track], [vehicle], [np.repeat(track.motor[:, None], TICKS, 1)])
    without, turned = physics.predict(with_propellers)[0][:, -1, RATES]
    gained = np.sqrt([0.6, 0.4, 0.6, 0.4]) - np.sqrt(0.4)
    gained = float(vehicle.max_rotor_speed) * gained @ np.asarray(vehicle.rotor_spin, float)
    np.testing.assert_allclose(
        turned - without, [0.0, 0.0, 0.002 * gained], atol=1e-3 * abs(gained) * 0.002
    )
