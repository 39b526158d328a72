"""Random crashes (floor, pillar, drone on drone, pillar and floor at once), by `rigid`
and by MuJoCo C on the same model.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.arena import Arena
from openjax.vehicle.mjx_body import world_xml
from openjax.vehicle.solids import encounters, place_solids, surroundings

DT = 0.01
DRONES = 3
PILLARS = 5
KINDS = ("floor", "pillar", "drone on drone", "pillar and floor at once")
STEPS = 10
"""Of the flights, .1 s."""


def crashes(number, seed):
    """Starts (B, 3, ...) of drones about to crash, each kind as often; none of them
    inside anything.
    """
    draw = np.random.default_rng(seed)
    pillar = draw.uniform(-0.6, 0.6, (number, PILLARS, 2))
    active = draw.random((number, PILLARS)) < 0.8
    position = draw.uniform([-0.8, -0.8, 0.06], [0.8, 0.8, 0.6], (number, DRONES, 3))
    velocity = draw.normal(0, 1, (number, DRONES, 3))
    kind = np.arange(number) % 4
    floor = kind == 0
    beside = (kind == 1) | (kind == 3)
    both = kind == 3
    position[floor, 0, 2] = 0.05 + draw.uniform(0, 0.05, floor.sum())
    velocity[floor, 0, 2] = -np.abs(velocity[floor, 0, 2]) - 0.5
    angle, active[beside, 0] = draw.uniform(0, 2 * np.pi, beside.sum()), True
    outward = np.stack([np.cos(angle), np.sin(angle)], -1)
    position[beside, 0, :2] = pillar[beside, 0] + outward * draw.uniform(
        0.15, 0.19, (beside.sum(), 1)
    )
    velocity[beside, 0, :2] = -outward * draw.uniform(0.3, 2, (beside.sum(), 1)) + draw.normal(
        0, 0.5, (beside.sum(), 2)
    )
    position[both, 0, 2] = 0.05 + draw.uniform(0, 0.03, both.sum())
    velocity[both, 0, 2] = -draw.uniform(0.2, 2, both.sum())
    pair = kind == 2
    along = draw.normal(size=(pair.sum(), 3))
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    position[pair, 1] = position[pair, 0] + along * draw.uniform(0.1, 0.15, (pair.sum(), 1))
    velocity[pair, 0] += along * draw.uniform(0, 1.5, (pair.sum(), 1))
    velocity[pair, 1] -= along * draw.uniform(0, 1.5, (pair.sum(), 1))
    to_pillar = np.linalg.norm(position[:, :, None, :2] - pillar[:, None], axis=-1) - 0.15
    apart = [
        np.linalg.norm(position[:, i] - position[:, j], axis=-1)
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    gaps = [
        position[..., 2].min(1) - 0.05,
        np.where(active[:, None], to_pillar, 9).min((1, 2)),
        np.min(apart, 0) - 0.1,
    ]
    quaternion = draw.normal([1, 0, 0, 0], [0, 0.3, 0.3, 0.3], (number, DRONES, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    command = draw.uniform([0, -3, -3, -3], [0.9, 3, 3, 3], (number, DRONES, 4))
    start = (position, velocity, quaternion, command, pillar, active)
    return [leaf[np.min(gaps, 0) > 0] for leaf in (*start, kind)]


def flown(start, dtype, steps=STEPS):
    """Positions and velocities (B, T, 3, 3), attitudes and body rates over T `steps`,
    and those of free flight.
    """
    vehicle = load_vehicle(dtype=dtype)

    def one(position, velocity, quaternion, command, pillar, active):
        def fly(contacts):
            step = make_drones_step("rigid", dt=DT, contacts=contacts)
            first = hover_state(vehicle, position, quaternion, velocity)

            def advance(drones, _):
                drones = step(vehicle, drones, command, pillar, active)
                return drones, (
                    drones.position,
                    drones.velocity,
                    drones.quaternion,
                    drones.body_rates,
                )

            return jax.lax.scan(advance, first, None, length=steps)[1]

        return fly(True), fly(False)

    arrays = [jnp.asarray(leaf, bool if leaf.dtype == bool else dtype) for leaf in start]
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(*arrays))


def by_mujoco(start, free):
    """Positions, velocities (B, T, 3, 3) over as many steps as `free` has, and what is
    touched (B, T, 3, things) by MuJoCo C.

    The spheres have no friction, so attitudes and thrusts, and with them free
    accelerations, are those of free flight.
    """
    position, velocity, _, _, pillar, active = start
    model = mujoco.MjModel.from_xml_string(world_xml(Arena(), PILLARS, DRONES - 1, DT))
    model.geom_sameframe[:] = 0  # else geoms compiled at the origin stay there
    data = mujoco.MjData(model)
    drone = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "drone")
    things = np.array([geom for geom in range(model.ngeom) if geom != drone])
    speeds = np.concatenate([velocity[:, None], free[1]], axis=1)
    force = model.body_mass[1] * (np.diff(speeds, axis=1) / DT + [0, 0, 9.81])

    @jax.jit
    @jax.vmap
    def place(position, velocity, pillar, active):
        around = surroundings(position, velocity, pillar, active)
        return jax.vmap(lambda p, v, a: place_solids(encounters(Arena(), p, v, a, DT)))(
            position, velocity, around
        )

    positions = []
    velocities = []
    touched = []
    for t in range(force.shape[1]):
        shapes = np.asarray(place(position, velocity, pillar, active))
        acceleration = np.zeros_like(position)
        hit = np.zeros((*position.shape[:2], len(things)), bool)
        for b, n in np.ndindex(*position.shape[:2]):
            model.geom_pos[things] = shapes[b, n]
            data.qpos[:3], data.qvel[:3], data.qfrc_applied[:3] = (
                position[b, n],
                velocity[b, n],
                force[b, t, n],
            )
            mujoco.mj_forward(model, data)
            acceleration[b, n] = data.qacc[:3]
            for contact in data.contact[: data.ncon]:
                if data.efc_force[contact.efc_address] > 0:
                    hit[b, n, list(things).index(min(contact.geom))] = True
        velocity = velocity + DT * acceleration
        position = position + DT * velocity
        positions.append(position), velocities.append(velocity), touched.append(hit)
    return [np.stack(leaf, axis=1) for leaf in (positions, velocities, touched)]
