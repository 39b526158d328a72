"""Starts that crash, and which any commands would save: `python -m experiments.evaders.starts --policy NAME ... [--number 768]`.

Uniform tasks, drawn attitudes, drawn vehicles of the policies' family, no clamp, the paper's evader. A crash counts within .4 s.
For each pursuer that crashes under some policy the cross-entropy method (Rubinstein, 1999) looks for commands that touch neither
pillar nor floor, the other pursuers left out. Where it finds none the start is lost: at most so many of these can't be saved.
Writes experiments/results/starts.json and .md (`--out`: others). Rows with the nominal vehicle: this file at b32e625.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.commands.command_line import run_command
from openjax.pursuit import Pursuit, PursuitSettings, RewardSettings, Task, turn_task, uniform_task
from openjax.pursuit.collisions import TOUCH, pillar_distance
from openjax.pursuit.environment import action_to_command
from openjax.pursuit.observation import rotation_axes
from openjax.store.policies import load_policy
from openjax.vehicle import DroneState
from openjax.vehicle.solids import DRONE_RADIUS

TASKS_KEY, STARTS_KEY, SEARCH_KEY = 99, 3, 7
STEPS, PIECE = 40, 4
"""Control steps that are looked at (of 10 ms), and how many a command is held for in the search."""
DRAWS, BEST, ROUNDS = 256, 24, 20
"""Of the search: commands in a round, those that the next round's are drawn about, rounds."""
ENOUGH = 0.05
"""Gap (m) beyond which a wider one is no better."""


def game_of(settings: PursuitSettings) -> PursuitSettings:
    """The game of all policies: theirs, with the paper's evader and pillars."""
    return dataclasses.replace(
        settings,
        evaders=("field",),
        min_pillars=4,
        max_pillars=5,
        physics="stops",
        speed_limit="none",
        substeps=5,
        reward=RewardSettings(),
    )


def crashes(environment: Pursuit, policy, parameters, world) -> np.ndarray:
    """(W, N) whether each pursuer crashes within `STEPS`; `world` is observations and states at their starts."""

    @jax.jit
    def fly(parameters, world):
        def one(world, _):
            observation, state = world
            action = policy.act(parameters, observation)
            observation, state, *_, info = jax.vmap(environment.step, (None, 0, 0))(
                jax.random.key(0), state, action
            )
            return (observation, state), info.crashed

        return jnp.any(jax.lax.scan(one, world, length=STEPS)[1], axis=0)

    return np.asarray(fly(parameters, world))


@functools.partial(jax.jit, static_argnums=0)
def widest(free: Pursuit, task: Task, drone: DroneState, vehicles) -> jax.Array:
    """() m, least gap to pillars and floor under the best commands found for one drone that flies alone; at most `ENOUGH`."""
    drones = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (DRAWS, *leaf.shape)), drone)
    pillars = task.pillar_position, task.pillar_active
    many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (DRAWS, *leaf.shape)), vehicles)

    def each(drones, command, many):
        one = jax.vmap(lambda d, c, m: free.dynamics(free.vehicle, d, c, *pillars, m))
        out = one(*jax.tree.map(lambda leaf: leaf[:, None], (drones, command, many)))
        return jax.tree.map(lambda leaf: leaf[:, 0], out)

    def score(pieces):
        def one(carry, action):
            drones, least = carry
            drones = each(drones, action_to_command(action), many)
            gap = pillar_distance(free.settings, drones.position, pillars[0])
            gap = jnp.min(jnp.where(pillars[1], gap, jnp.inf), axis=-1)
            gap = jnp.minimum(gap, drones.position[:, 2]) - DRONE_RADIUS
            upright = rotation_axes(drones.quaternion)[1][:, 2]
            return (drones, jnp.minimum(least, gap + jnp.minimum(upright, 0.0))), None

        actions = jnp.repeat(jnp.moveaxis(pieces, 1, 0), PIECE, axis=0)
        return jax.lax.scan(one, (drones, jnp.full(DRAWS, ENOUGH)), actions)[0][1]

    def search(carry, key):
        mean, spread, found = carry
        pieces = jnp.clip(mean + spread * jax.random.normal(key, (DRAWS, *mean.shape)), -1.0, 1.0)
        gaps = score(pieces)
        best = pieces[jax.lax.top_k(gaps, BEST)[1]]
        return (best.mean(0), best.std(0) + 0.03, jnp.maximum(found, jnp.max(gaps))), None

    size = (STEPS // PIECE, 4)
    keys = jax.random.split(jax.random.key(SEARCH_KEY), ROUNDS)
    return jax.lax.scan(search, (jnp.zeros(size), jnp.ones(size), -jnp.inf), keys)[0][2]


def study(options) -> dict:
    """Fly the policies, then search for commands."""
    loaded = {name: load_policy(name) for name in options.policy}
    environment = Pursuit(game_of(next(iter(loaded.values())).settings.environment))
    game, keys = environment.settings, jax.random.split(jax.random.key(TASKS_KEY), options.number)
    draw = jax.vmap(lambda key: turn_task(jax.random.fold_in(key, 1), uniform_task(game, key)))
    tasks = jax.jit(draw)(keys)
    keys = jax.random.split(jax.random.key(STARTS_KEY), options.number)
    world = jax.jit(jax.vmap(environment.reset_to))(keys, tasks)
    by_policy = {
        name: crashes(environment, own.in_game(environment).policy, own.parameters, world)
        for name, own in loaded.items()
    }
    free = Pursuit(dataclasses.replace(game, physics="rigid", contacts=False))
    gaps = {}
    for at in zip(*np.where(np.logical_or.reduce(list(by_policy.values()))), strict=True):
        task, drone = jax.tree.map(lambda leaf, w=at[0]: leaf[w], tasks), world[1].drones
        gaps[at] = float(
            widest(
                free,
                task,
                jax.tree.map(lambda leaf, i=at: leaf[i], drone),
                jax.tree.map(lambda leaf, i=at: leaf[i], world[1].vehicles),
            )
        )
    lost = {world for (world, _), gap in gaps.items() if gap < TOUCH}
    found = {
        "number": options.number,
        "commands": DRAWS * ROUNDS,
        "rows": [
            {
                "policy": name,
                "crashes": int(crashed.any(axis=1).sum()),
                "rate": float(crashed.any(axis=1).mean()),
                "lost": sum(bool(crashed[world].any()) for world in lost),
            }
            for name, crashed in by_policy.items()
        ],
    }
    return {"vehicles": {"Drawn vehicles": found}}


def page(results: dict) -> Page:
    """Crashes of each policy, and how many of their starts are lost, by kind of vehicles."""
    columns = {
        "policy": "policy",
        "starts that crash": "crashes",
        "share": "rate:.4f",
        "of these lost": "lost",
    }
    tables = [
        Table(
            columns,
            part["rows"],
            title=f"{name}, {part['number']} tasks, {part['commands']} commands a start",
        )
        for name, part in results["vehicles"].items()
    ]
    prose = (
        "Uniform tasks with three pursuers that lean by up to 36 degrees, no clamp: episodes in which some pursuer touches "
        "something within .4 s. Lost: the cross-entropy method finds no commands that keep that pursuer off pillars and floor. "
        "So many at most can't be saved; touches between pursuers aren't searched for."
    )
    return Page("Starts that crash", prose, tables)


def main(arguments: list[str]) -> int:
    """Count and write both files."""
    parser = page_parser(__doc__, "starts")
    parser.add_argument("--policy", nargs="+", default=["flight", "evaders"], help="names or policy files")
    parser.add_argument("--number", type=int, default=768, help="tasks")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
