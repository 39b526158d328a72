"""How well do the written-out contacts of `rigid` agree with MuJoCo C? `python -m experiments.crashes [--number 10000]`.

Random crashes (floor, pillar, drone on drone, pillar and floor at once) flown by `rigid` and by MuJoCo C on the same model:
positions, velocities and what is touched over .1 s, then over 1 s how far each of them goes apart from itself when the starts
are moved by 1e-6, which no agreement can fall below. Writes experiments/results/crashes.json and .md (`--out`: others).
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from experiments.pages import page_parser, publish, table, where
from openjax.commands.command_line import run_command
from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.arena import Arena
from openjax.vehicle.mjx_body import world_xml
from openjax.vehicle.solids import encounters, place_solids, surroundings

DT, DRONES, PILLARS = 0.01, 3, 5
KINDS = ("floor", "pillar", "drone on drone", "pillar and floor at once")
SHORT, LONG = 10, 100
"""Steps of .1 s and 1 s."""
MOVED = 1e-6
"""By which starts are moved (m and m/s, standard deviation)."""


def crashes(number, seed):
    """Starts (B, 3, ...) of drones about to crash, each kind as often; none of them inside anything."""
    draw = np.random.default_rng(seed)
    pillar = draw.uniform(-0.6, 0.6, (number, PILLARS, 2))
    active = draw.random((number, PILLARS)) < 0.8
    position = draw.uniform([-0.8, -0.8, 0.06], [0.8, 0.8, 0.6], (number, DRONES, 3))
    velocity = draw.normal(0, 1, (number, DRONES, 3))
    kind = np.arange(number) % 4
    floor, beside, both = kind == 0, (kind == 1) | (kind == 3), kind == 3
    position[floor, 0, 2] = 0.05 + draw.uniform(0, 0.05, floor.sum())
    velocity[floor, 0, 2] = -np.abs(velocity[floor, 0, 2]) - 0.5
    angle, active[beside, 0] = draw.uniform(0, 2 * np.pi, beside.sum()), True
    outward = np.stack([np.cos(angle), np.sin(angle)], -1)
    position[beside, 0, :2] = pillar[beside, 0] + outward * draw.uniform(0.15, 0.19, (beside.sum(), 1))
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
    apart = [np.linalg.norm(position[:, i] - position[:, j], axis=-1) for i, j in ((0, 1), (0, 2), (1, 2))]
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


def flown(start, dtype, steps=SHORT):
    """Positions and velocities (B, T, 3, 3), attitudes and body rates over T `steps`, and those of free flight."""
    vehicle = load_vehicle(dtype=dtype)

    def one(position, velocity, quaternion, command, pillar, active):
        def fly(contacts):
            step = make_drones_step("rigid", dt=DT, contacts=contacts)
            first = hover_state(vehicle, position, quaternion, velocity)

            def advance(drones, _):
                drones = step(vehicle, drones, command, pillar, active)
                return drones, (drones.position, drones.velocity, drones.quaternion, drones.body_rates)

            return jax.lax.scan(advance, first, None, length=steps)[1]

        return fly(True), fly(False)

    arrays = [jnp.asarray(leaf, bool if leaf.dtype == bool else dtype) for leaf in start]
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(*arrays))


def by_mujoco(start, free):
    """Positions, velocities (B, T, 3, 3) over as many steps as `free` has, and what is touched (B, T, 3, things) by MuJoCo C.

    The spheres have no friction, so attitudes and thrusts, and with them free accelerations, are those of free flight.
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

    positions, velocities, touched = [], [], []
    for t in range(force.shape[1]):
        shapes = np.asarray(place(position, velocity, pillar, active))
        acceleration, hit = np.zeros_like(position), np.zeros((*position.shape[:2], len(things)), bool)
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


def deviation(one, other) -> dict:
    """Of positions (m) and velocities (m/s): the median over the crashes, 95 and 99 in a hundred, the largest."""
    found = {}
    for name, a, b in zip(("position", "velocity"), one, other, strict=False):
        worst = np.max(np.linalg.norm(a - b, axis=-1), axis=(1, 2))
        found[name] = [float(x) for x in (*np.quantile(worst, (0.5, 0.95, 0.99)), worst.max())]
    return found


def study(options) -> dict:
    """Fly the crashes."""
    with jax.enable_x64(True):
        *start, kind = crashes(options.number, options.seed)
        exact, free = flown(start, jnp.float64)
        rounded = flown(start, jnp.float32)[0]
        reference = by_mujoco(start, free)
        short = {
            "rigid, float64": deviation(exact, reference),
            "rigid, float32": deviation(rounded, reference),
        }
        touched = reference[2]
        start = [leaf[: options.long] for leaf in start]
        draw = np.random.default_rng(options.seed + 1)
        moved = [leaf + draw.normal(0, MOVED, leaf.shape) for leaf in start[:2]] + start[2:]
        one, free = flown(start, jnp.float64, LONG)
        other, free_other = flown(moved, jnp.float64, LONG)
        mujoco_one, mujoco_other = by_mujoco(start, free), by_mujoco(moved, free_other)
        long = {
            "rigid against itself, moved": deviation(one, other),
            "MuJoCo C against itself, moved": deviation(mujoco_one, mujoco_other),
            "rigid, float64, against MuJoCo C": deviation(one, mujoco_one),
            "rigid, float32, against MuJoCo C": deviation(flown(start, jnp.float32, LONG)[0], mujoco_one),
        }
    kinds = {name: int(np.sum(kind == i)) for i, name in enumerate(KINDS)}
    return {
        "kinds": kinds,
        "touching": float(touched.any((1, 2, 3)).mean()),
        "short": short,
        "long": long,
        "number_long": len(start[0]),
    }


def report(results: dict) -> list[str]:
    """The page."""

    def rows(found):
        return [
            [name, what, *(f"{value:.1e}" for value in values)]
            for name, both in found.items()
            for what, values in both.items()
        ]

    heads = ["", "largest difference over a crash, m and m/s", "median", "95 %", "99 %", "largest"]
    kinds = ", ".join(f"{number} {name}" for name, number in results["kinds"].items())
    return [
        "# Contacts of the rigid step against MuJoCo C",
        "",
        f"{where(results)} {results['seconds']:.0f} s. Random crashes of three drones among five pillars, steps of "
        f"10 ms: {kinds}; "
        f"in {results['touching']:.2f} of them something is touched within .1 s.",
        "",
        "Over .1 s, against MuJoCo C:",
        "",
        *table(heads, rows(results["short"])),
        "",
        f"Over 1 s, the first {results['number_long']} of them; moved: starts with {MOVED:.0e} m and m/s of noise.",
        "",
        *table(heads, rows(results["long"])),
    ]


def main(arguments: list[str]) -> int:
    """Fly, write both files."""
    parser = page_parser(__doc__, "crashes")
    parser.add_argument(
        "--number",
        type=int,
        default=10_000,
        help="crashes drawn; those that begin inside something are left out",
    )
    parser.add_argument("--long", type=int, default=1_000, help="of them, how many fly for 1 s")
    parser.add_argument("--seed", type=int, default=0)
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
