"""The physics along several tracks at once against one track and one parameter vector at a time."""

import numpy as np

from openjax.flights.track import Track
from openjax.gap.model.library import ABSENT, STEP
from openjax.gap.model.observer import TICKS
from openjax.gap.model.prediction import LANES, make_physics
from openjax.vehicle import load_vehicle


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
    tracks, vehicles = (
        [track_of(200 + 10 * k, k) for k in range(3)],
        [light, light.replace(mass=0.9 * light.mass), light],
    )
    ticks = [np.repeat(t.motor[:, None], TICKS, 1) for t in tracks]
    theta = ABSENT + 5.0 * STEP * np.random.default_rng(9).uniform(0.0, 1.0, (LANES // 2, len(ABSENT)))
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
