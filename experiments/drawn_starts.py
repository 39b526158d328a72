"""How many collisions do drawn starts force? `python -m experiments.drawn_starts [--episodes 100]`.

Drawn starts tilt each drone by up to 36 degrees in roll and in pitch, near pillars, neighbours and bounds. Here nothing is
pursued: commands of the first two seconds are optimised for each episode, by gradients through the rigid physics and
knowing all of the start, for nothing but few breaches and no crash. What is left is about what no policy can avoid.
Writes experiments/results/drawn_starts.json and .md.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.headline import GOAL_COLLISION
from experiments.pages import page_parser, publish, table, where
from experiments.prediction_flights import layout_tasks
from openjax.commands.command_line import run_command
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, Task, action_to_command
from openjax.pursuit.collisions import breaches, crashed, drone_distance, pillar_distance
from openjax.pursuit.observation import rotation_axes
from openjax.vehicle import DroneState, make_drones_step
from openjax.vehicle.solids import DRONE_RADIUS

STEPS = 200
"""Control steps that are flown; then all is calm."""
HOLD = 4
"""Control steps for which an optimised command is held."""
ATTITUDE, POSITION, VELOCITY = 12.0, 6.0, 4.5
"""Gains of the controller that the optimisation starts from: 1/s, 1/s^2, 1/s."""


def hold_action(environment: Pursuit, drones: DroneState, target: jax.Array) -> jax.Array:
    """(N, 4) action in -1..1 of a controller that levels the drones (leading axis N) and holds `target` (N, 3)."""
    vehicle = environment.vehicle
    wanted = POSITION * (target - drones.position) - VELOCITY * drones.velocity
    wanted = jnp.clip(wanted, -8.0, 8.0) + jnp.array([0.0, 0.0, 1.0]) * vehicle.gravity
    body_x, body_z = rotation_axes(drones.quaternion)
    body_y = jnp.cross(body_z, body_x)
    direction = wanted / jnp.linalg.norm(wanted, axis=-1, keepdims=True)
    turn = ATTITUDE * jnp.cross(body_z, direction)
    rates = jnp.stack([jnp.sum(turn * body_x, axis=-1), jnp.sum(turn * body_y, axis=-1)], axis=-1)
    most = 4 * vehicle.thrust_constant * vehicle.max_rotor_speed**2
    thrust = vehicle.mass * jnp.sum(wanted * body_z, axis=-1, keepdims=True) / most
    return jnp.concatenate([2 * thrust - 1, rates / jnp.pi, jnp.zeros_like(thrust)], axis=-1)


def fly(environment: Pursuit, task: Task, drones: DroneState, plan: dict[str, jax.Array]):
    """One world for `STEPS`: (cost () to descend, exact collision steps (), whether any drone crashed ())."""
    settings = environment.settings
    pillars = task.pillar_position, task.pillar_active
    step = make_drones_step(physics="rigid", dt=settings.time_step, contacts=False)
    target = drones.position + plan["target"]

    def near(distance, limit):
        """A smooth count of what is too close, and a slope further out."""
        return jax.nn.sigmoid((limit - distance) / 0.008), jax.nn.relu(limit + 0.03 - distance)

    @jax.checkpoint
    def one(drones, change):
        action = jnp.clip(hold_action(environment, drones, target) + change, -1.0, 1.0)
        drones = step(environment.vehicle, drones, action_to_command(action), *pillars)
        speed = jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1, keepdims=True) + 1e-12)
        drones = drones.replace(velocity=drones.velocity * jnp.minimum(1.0, settings.max_speed / speed))
        position, up = drones.position, rotation_axes(drones.quaternion)[1][:, 2]
        to_pillar = jnp.where(task.pillar_active, pillar_distance(settings, position, pillars[0]), 9.0)
        apart = drone_distance(position)
        apart = jnp.where(jnp.isfinite(apart), apart, 9.0)
        to_wall = settings.arena_radius - jnp.sqrt(jnp.sum(position[:, :2] ** 2, axis=-1) + 1e-12)
        kinds = [
            near(to_pillar, settings.pillar_clearance),
            near(apart, settings.drone_clearance),
            near(to_wall, 0.0),
            near(settings.arena_height - position[:, 2], 0.0),
        ]
        solid = [
            near(to_pillar, DRONE_RADIUS),
            near(apart, 2 * DRONE_RADIUS),
            near(position[:, 2], DRONE_RADIUS),
            near(up, 0.0),
        ]
        free = jnp.prod(jnp.stack([jnp.prod(1 - count) for count, _ in kinds]))
        slope = sum(jnp.sum(slope) for _, slope in [*kinds, *solid])
        touch = sum(jnp.sum(count) for count, _ in solid)
        cost = 1 - free + 2.0 * slope + touch
        breach = jnp.any(breaches(settings, position, *pillars).total > 0)
        crash = jnp.any(crashed(settings, position, up, *pillars))
        return drones, (cost, breach, crash)

    change = jnp.repeat(plan["change"], HOLD, axis=0)
    _, (cost, breach, crash) = jax.lax.scan(one, drones, change)
    return jnp.sum(cost), jnp.sum(breach.astype(jnp.float32)), jnp.any(crash)


@functools.partial(jax.jit, static_argnums=(0, 3))
def least(environment: Pursuit, tasks: Task, drones: DroneState, iterations: int):
    """(B, 2) collision steps and crash when just held, and of the best plan; a crash counts as an episode of breaches."""
    number, pursuers = drones.position.shape[:2]
    plan = {
        "target": jnp.zeros((number, pursuers, 3)),
        "change": jnp.zeros((number, STEPS // HOLD, pursuers, 4)),
    }
    optimiser = optax.adam(optax.cosine_decay_schedule(0.05, iterations))

    def total(plan):
        cost, breach, crash = jax.vmap(lambda *world: fly(environment, *world))(tasks, drones, plan)
        return jnp.sum(cost), jnp.stack([breach, crash.astype(jnp.float32)], axis=-1)

    def iterate(carry, _):
        plan, state, best = carry
        (_, counted), gradient = jax.value_and_grad(total, has_aux=True)(plan)
        size = jax.tree.map(
            lambda g: jnp.sqrt(jnp.sum(g**2, axis=tuple(range(1, g.ndim)), keepdims=True) + 1e-12), gradient
        )
        gradient = jax.tree.map(lambda g, s: jnp.nan_to_num(g / s), gradient, size)
        change, state = optimiser.update(gradient, state)

        def worth(x):
            return x[:, 0] + STEPS * x[:, 1]

        best = jnp.where((worth(counted) < worth(best))[:, None], counted, best)
        return (optax.apply_updates(plan, change), state, best), counted

    start = (plan, optimiser.init(plan), jnp.full((number, 2), jnp.inf))
    (_, _, best), history = jax.lax.scan(iterate, start, length=iterations)
    return history[0], best


def study(options: argparse.Namespace) -> dict:
    """Figures by layout."""
    settings = PursuitSettings(
        physics="rigid", max_pillars=max(len(scenario.pillars) for scenario in SCENARIOS.values())
    )
    environment = Pursuit(settings)
    tasks = layout_tasks(settings, options.episodes)
    keys = jax.random.split(jax.random.key(0), tasks.evader_position.shape[0])
    drones = jax.jit(jax.vmap(environment.reset_to))(keys, tasks)[1].drones
    parts = [np.asarray(part) for part in least(environment, tasks, drones, options.iterations)]
    parts = [part.reshape(len(SCENARIOS), options.episodes, 2) for part in parts]
    rows = {}
    for i, layout in enumerate(SCENARIOS):
        rows[layout] = {
            kind: {
                "collision_rate": float(part[i, :, 0].mean() / settings.episode_length),
                "episodes_with_a_breach": float((part[i, :, 0] > 0).mean()),
                "crash_rate": float(part[i, :, 1].mean()),
            }
            for kind, part in zip(("held", "least"), parts, strict=True)
        }
    return {
        "episodes": options.episodes,
        "episode_length": settings.episode_length,
        "layouts": rows,
    }


def report(results: dict) -> list[str]:
    """The page."""
    rows = []
    for layout, kinds in results["layouts"].items():
        cells = []
        for kind in ("held", "least"):
            figures = kinds[kind]
            cells += [
                f"{figures['episodes_with_a_breach']:.2f}",
                f"{figures['collision_rate']:.4f}",
                f"{figures['crash_rate']:.2f}",
            ]
        rows.append([layout, *cells, str(GOAL_COLLISION.get(layout, "–"))])
    return [
        "# How many collisions drawn starts force",
        "",
        f"{where(results)} "
        f"{results['seconds']:.0f} s. {results['episodes']} drawn starts per layout, rigid physics, speed clamp.",
        "",
        "Held: a controller levels each drone and holds its start. Least: commands of the first two seconds optimised for "
        "each episode, knowing the whole start, for nothing but few breaches and no crash, without pursuing anything. The "
        f"collision rate counts the steps with a breach over a whole episode of {results['episode_length']}, as if there were "
        "none later: a policy that pursues can't be expected to come out below.",
        "",
        *table(
            ["layout"]
            + [
                f"{kind}: {figure}"
                for kind in ("held", "least")
                for figure in ("episodes with a breach", "collision rate", "crash rate")
            ]
            + ["goal: collision rate"],
            rows,
        ),
    ]


def main(arguments: list[str]) -> int:
    """Optimise or read, write both files, print the page."""
    parser = page_parser(__doc__, "drawn_starts")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=60)
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
