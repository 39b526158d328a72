"""Floor, pillars and other drones are solid: nothing is flown through, at speed or
under full thrust.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.vehicle import hover_state, load_vehicle, make_drones_step

PILLARS = np.array(
    [[0.5, 0.0], [0.5, 0.2], [0.3, 0.4], [-0.5, 0.0], [0.0, -0.4]]
)  # diagonal: 83 mm apart
ACTIVE = np.array([True, True, True, True, False])
START = np.array([[0.0, 0.0, 0.5], [0.0, 0.8, 0.5], [-0.3, -0.8, 0.5]])
LEVEL = np.array([1.0, 0, 0, 0])


def turned(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis]


def gaps(position):
    """Smallest gap (m) to floor, active pillars and each other over a flight (T, 3,
    3).
    """
    pillar = np.linalg.norm(position[:, :, None, :2] - PILLARS[ACTIVE], axis=-1) - 0.15
    pillar = np.where(position[:, :, None, 2] < 1.2, pillar, np.inf)
    pairs = [
        np.linalg.norm(position[:, i] - position[:, j], axis=-1)
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    return position[..., 2].min() - 0.05, pillar.min(), np.min(pairs) - 0.1


@pytest.fixture(scope="module", params=["mjx", "rigid"])
def fly(request):
    """fly(position, velocity, quaternion, thrust) -> positions (150, 3, 3) and
    velocities of three drones.
    """
    vehicle = load_vehicle()
    step = make_drones_step(request.param)

    @jax.jit
    def flight(position, velocity, quaternion, thrust):
        command = jnp.zeros((3, 4)).at[:, 0].set(thrust)

        def advance(drones, _):
            drones = step(vehicle, drones, command, jnp.asarray(PILLARS), jnp.asarray(ACTIVE))
            return drones, (drones.position, drones.velocity)

        return jax.lax.scan(
            advance, hover_state(vehicle, position, quaternion, velocity), None, length=150
        )[1]

    def run(position=START, velocity=((0, 0, 0),) * 3, quaternion=(LEVEL,) * 3, thrust=0.6):
        velocity = np.asarray(velocity, float)
        quaternion = np.asarray(quaternion)
        return jax.tree.map(np.asarray, flight(np.asarray(position), velocity, quaternion, thrust))

    return run


TO_THE_PILLAR = turned([0, 1, 0], np.pi / 2)
TO_THE_WEDGE = turned([0, 1, 0], np.pi / 2)


@pytest.mark.parametrize(
    "case",
    {
        "thrown at a pillar": {"velocity": [[2, 0, 0], [0, 0, 0], [0, 0, 0]]},
        "thrown at the floor": {"velocity": [[0, 0, -2], [0, 0, -4], [1, 0, -1]], "thrust": 0.0},
        "thrown into a wedge": {"position": [[0, 0.1, 0.5], *START[1:]],
                                "velocity": [[2, 0, 0], [0, 0, 0], [0, 0, 0]]},
        "pressed to a pillar": {"quaternion": [TO_THE_PILLAR, LEVEL, LEVEL], "thrust": 0.9},
        "pressed into a wedge": {"position": [[0.2, 0.1, 0.5], *START[1:]],
                                 "quaternion": [TO_THE_WEDGE, LEVEL, LEVEL], "thrust": 0.9},
        "pressed to the floor": {"quaternion": [turned([1, 0, 0], np.pi)] * 3, "thrust": 0.9},
        "head on": {"position": [[0, 0.2, 0.5], *START[1:]], "velocity": [[0, 2, 0], [0, -2, 0], [0, 0, 0]]},
    }.items(),
    ids=lambda case: case[0],
)  # fmt: skip
def test_nothing_is_entered(fly, case):
    position, _ = fly(**case[1])
    floor, pillar, drones = gaps(position)
    assert np.isfinite(position).all()
    assert min(floor, pillar, drones) > -0.003
    assert min(floor, pillar, drones) < 0.001, "the case must touch something"


def test_drones_stay_solid_between_floor_and_pillar(fly):
    """A drone driven at 3 m/s into another that can't yield: soft for a moment, never
    passed.
    """
    onto = fly(
        position=[[0, 0.6, 0.08], [0, 0.6, 0.5], START[2]],
        velocity=[[0, 0, 0], [0, 0, -3], [0, 0, 0]],
    )[0]
    assert (onto[:, 1, 2] > onto[:, 0, 2]).mean() > 0.1 and gaps(onto)[2] > -0.025
    against = fly(
        position=[[0.35, 0, 0.5], [0.2, 0, 0.5], START[2]],
        velocity=[[0, 0, 0], [3, 0, 0], [0, 0, 0]],
    )[0]
    assert gaps(against)[2] > -0.025 and gaps(against)[1] > -0.005


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.0])
def test_no_gap_narrower_than_a_drone_is_passed(fly, speed):
    """83 mm between the diagonal pillars at (0.5, 0.2) and (0.3, 0.4); a drone is 100
    mm wide.
    """
    across = np.array([0.2, -0.2]) / np.hypot(0.2, 0.2)
    through = np.array([1.0, 1.0]) / np.sqrt(2)
    draw = np.random.default_rng(1)
    for angle, offset in zip(
        draw.uniform(-0.5, 0.5, 12), draw.uniform(-0.03, 0.03, 12), strict=True
    ):
        heading = (
            np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ through
        )
        start = np.array([0.4, 0.3]) + offset * across - 0.2 * heading
        pressed = turned([-heading[1], heading[0], 0], np.pi / 2)
        for quaternion, thrust in ((LEVEL, 0.62), (pressed, 0.9)):
            position, _ = fly(
                position=[[*start, 0.6], *START[1:]],
                velocity=[[*(speed * heading), 0], [0, 0, 0], [0, 0, 0]],
                quaternion=[quaternion, LEVEL, LEVEL],
                thrust=thrust,
            )
            relative = position[:, 0, :2] - [0.4, 0.3]
            inside = (np.abs(relative @ across) < 0.141) & (position[:, 0, 2] < 1.2)
            assert not (inside & (relative @ through > 0)).any()


def test_drones_keep_their_momentum_when_they_meet(fly):
    position, velocity = fly(
        position=[[0, 0.3, 0.5], *START[1:]], velocity=[[0, 1, 0], [0, -0.5, 0], [0, 0, 0]]
    )
    met = np.argmin(np.linalg.norm(position[:, 0] - position[:, 1], axis=-1) > 0.102)
    np.testing.assert_allclose(velocity[met + 3, :2, 1].sum(), 0.5, atol=0.02)
    np.testing.assert_allclose(
        velocity[met + 3, 0, 1], velocity[met + 3, 1, 1], atol=0.05
    )  # they don't bounce


def test_a_drone_on_the_floor_lies_still(fly):
    position, velocity = fly(thrust=0.0)
    assert np.abs(position[-20:, :, 2] - 0.05).max() < 1e-3
    assert np.abs(velocity[-20:]).max() < 0.02


def test_an_inactive_pillar_is_not_there(fly):
    position, _ = fly(
        position=[[0, 0, 0.5], *START[1:]], velocity=[[0, -2, 0], [0, 0, 0], [0, 0, 0]], thrust=0.62
    )
    assert position[-1, 0, 1] < -0.6


def test_solids_change_nothing_in_free_flight(fly):
    """The flight by MJX among solids is that by the written-out equations, until
    something is touched.
    """
    vehicle = load_vehicle()
    step = make_drones_step("rigid", contacts=False)
    velocity = np.array([[0.2, 0.1, 0.3], [-0.1, 0.1, 0.2], [0.0, 0.2, 0.1]])
    tilt = np.stack([turned([1, 1, 0], 0.1), turned([1, 0, 1], -0.2), turned([0, 1, 1], 0.1)])
    command = jnp.zeros((3, 4)).at[:, 0].set(0.65)

    @jax.jit
    def flight(drones):
        def advance(drones, _):
            drones = step(vehicle, drones, command, jnp.asarray(PILLARS), jnp.asarray(ACTIVE))
            return drones, (drones.position, drones.velocity)

        return jax.lax.scan(advance, drones, None, length=60)[1]

    free = flight(hover_state(vehicle, START, tilt, velocity))
    among_solids = fly(velocity=velocity, quaternion=tilt, thrust=0.65)
    assert min(gaps(np.asarray(free[0]))) > 0.02
    for without, with_solids in zip(free, among_solids, strict=True):
        np.testing.assert_allclose(with_solids[:60], without, atol=5e-5)
