"""The learning evader against exact values: `python -m experiments.evaders.planar [--steps 20000000]`.

Points in a disc without pillars; each pursuer flies straight at the evader. What the evader can reach is then an optimal control
problem, solved on a grid by value iteration (time to the capture, at most 8 s). Beside it, from the same starts: the evader that
`openjax exploit` would learn, and the greedy one. And stack, inside and outside the bound of its theorem. Writes
experiments/results/evaders_planar.json and .md.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.table import Page, Table, page_parser, publish
from openjax.baselines.stack import Points, StackParameters, stack, stack_bound
from openjax.baselines.surroundings import Craft, surroundings
from openjax.commands.command_line import run_command
from openjax.learning.best_response import BestResponse
from openjax.learning.best_response_settings import BestResponseSettings
from openjax.pursuit import Pursuit, PursuitSettings, empty_task, uniform_task
from openjax.pursuit.evaders.behaviours import MARGIN

STEP = 0.04
"""Seconds of a step of the value iteration."""
HEADINGS = 32


class Planar(Pursuit):
    """The game in which nobody leaves the plane at half the arena's height."""

    def reset_to(self, key, task):
        """As `Pursuit.reset_to`, with all starts in the plane."""
        height = self.settings.arena_height / 2

        def flat(position):
            return position.at[..., 2].set(height)

        task = task.replace(
            pursuer_position=flat(task.pursuer_position),
            evader_position=flat(task.evader_position),
            pillar_active=jnp.zeros_like(task.pillar_active),
        )
        return super().reset_to(key, task)

    def step(self, key, state, action, wish=None):
        """As `Pursuit.step`, with a wish in the plane."""
        wish = None if wish is None else wish.at[2].set(0.0)
        return super().step(key, state, action, wish)


class Straight:
    """Pursuers that fly straight at the evader, for `Points`."""

    def act(self, parameters, observation):
        """(..., N, 4): no thrust, a direction."""
        to_evader = -observation.self_state[..., :3]
        size = jnp.sqrt(jnp.sum(to_evader**2, axis=-1, keepdims=True) + 1e-12)
        return jnp.concatenate([jnp.zeros_like(size), to_evader / size], axis=-1)


@dataclasses.dataclass(frozen=True)
class Stack:
    """Stack for `Points`."""

    craft: Craft

    def act(self, parameters, observation):
        """(..., N, 4): no thrust, a velocity as a share of the speed."""
        velocity = stack(self.craft, StackParameters(0.05, 100.0), surroundings(self.craft, observation))
        return jnp.concatenate([jnp.zeros_like(velocity[..., :1]), velocity / self.craft.speed], axis=-1)


def game(**changes) -> PursuitSettings:
    """Points in an arena without pillars."""
    settings = PursuitSettings(
        physics="stops", speed_limit="none", evaders=("learned",), min_pillars=0, max_pillars=1
    )
    return dataclasses.replace(settings, **changes)


def exact(settings: PursuitSettings, radii: int, angles: int, iterations: int) -> list[np.ndarray]:
    """Seconds to the capture under the best evader, on a grid of (evader's radius, each pursuer's radius and angle from it)."""
    n, most = settings.num_pursuers, settings.arena_radius
    radius = jnp.linspace(0.0, most, radii)
    angle = jnp.linspace(-jnp.pi, jnp.pi, angles)
    axes = [radius] * (1 + n) + [angle] * n
    grid = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1 + 2 * n)
    heading = 2 * jnp.pi * jnp.arange(HEADINGS) / HEADINGS
    moves = jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1) * settings.evader_speed * STEP
    moves = jnp.concatenate([moves, jnp.zeros((1, 2))])

    def place(states):
        evader = jnp.stack([states[:, 0], jnp.zeros_like(states[:, 0])], -1)
        r, a = states[:, 1 : 1 + n], states[:, 1 + n :]
        return evader, jnp.stack([r * jnp.cos(a), r * jnp.sin(a)], -1)

    def after(states, move):
        """Grid coordinates after a step, and whether the evader is caught in it."""
        evader, pursuers = place(states)
        moved = evader + move
        size = jnp.linalg.norm(moved, axis=-1, keepdims=True) + 1e-9
        moved = moved * jnp.minimum(1.0, (most - MARGIN) / size)
        towards = evader[:, None] - pursuers
        gap = jnp.linalg.norm(towards, axis=-1, keepdims=True) + 1e-9
        pursuers = pursuers + towards / gap * jnp.minimum(gap, settings.max_speed * STEP)
        caught = jnp.any(jnp.linalg.norm(moved[:, None] - pursuers, axis=-1) < settings.capture_radius, -1)
        turn = jnp.arctan2(moved[:, 1], moved[:, 0])[:, None]
        r = jnp.linalg.norm(pursuers, axis=-1)
        a = jnp.mod(jnp.arctan2(pursuers[..., 1], pursuers[..., 0]) - turn + jnp.pi, 2 * jnp.pi) - jnp.pi
        radial = jnp.concatenate([jnp.linalg.norm(moved, axis=-1)[:, None], r], -1) / most * (radii - 1)
        return jnp.concatenate([radial, (a + jnp.pi) / (2 * jnp.pi) * (angles - 1)], -1), caught

    shape = (radii,) * (1 + n) + (angles,) * n
    evader, pursuers = place(grid)
    now = jnp.any(jnp.linalg.norm(evader[:, None] - pursuers, axis=-1) < settings.capture_radius, -1)

    @jax.jit
    def improve(value):
        def best(so_far, move):
            where, caught = after(grid, move)
            later = jax.scipy.ndimage.map_coordinates(value, list(where.T), order=1, mode="nearest")
            return jnp.maximum(so_far, STEP + jnp.where(caught, 0.0, later)), None

        value = jax.lax.scan(best, jnp.zeros(grid.shape[0]), moves)[0]
        return jnp.where(now, 0.0, jnp.minimum(value, settings.episode_length * settings.time_step)).reshape(
            shape
        )

    value = jax.lax.fori_loop(0, iterations, lambda _, value: improve(value), jnp.zeros(shape))
    return [np.asarray(value), *(np.asarray(axis) for axis in axes)]


def look_up(table: list[np.ndarray], evader: np.ndarray, pursuers: np.ndarray) -> np.ndarray:
    """Exact seconds (B,) for starts (B, 3) and (B, N, 3), by linear interpolation."""
    value, *axes = table
    turn = np.arctan2(evader[:, 1], evader[:, 0])[:, None]
    angle = np.arctan2(pursuers[..., 1], pursuers[..., 0]) - turn
    angle = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    radius = np.linalg.norm(pursuers[..., :2], axis=-1)
    states = np.concatenate([np.linalg.norm(evader[:, :2], axis=-1)[:, None], radius, angle], -1)
    where = [(states[:, i] - a[0]) / (a[-1] - a[0]) * (len(a) - 1) for i, a in enumerate(axes)]
    return np.asarray(jax.scipy.ndimage.map_coordinates(value, where, order=1, mode="nearest"))


def learn(environment: Pursuit, policy, how: BestResponseSettings):
    """Seconds to the capture of the learned evader of each seed and of the greedy one (S + 1, B), and the starts."""
    settings = environment.settings
    layouts = jax.tree.map(lambda leaf: leaf[None], empty_task(settings))
    response = BestResponse(how, environment, policy, layouts)
    carry = jax.jit(response.start)(jax.random.key(0))
    step = jax.jit(response.step, donate_argnums=1)
    for _ in range(how.total_updates):
        carry, _ = step({}, carry)
    keys = jax.random.split(jax.random.key(77), 2048)
    tasks = jax.vmap(lambda key: uniform_task(settings, key))(keys)

    @jax.jit
    def fly(network):
        world = dataclasses.replace(environment, evader_network=network)

        def one(carry, _):
            observation, state = carry
            action = policy.act({}, observation)
            observation, state, *_ = jax.vmap(world.step, (None, 0, 0))(keys[0], state, action)
            return (observation, state), None

        start = jax.vmap(world.reset_to)(keys, tasks)
        return jax.lax.scan(one, start, length=settings.episode_length)[0][1].statistics

    networks = [jax.tree.map(lambda leaf, i=i: leaf[i], carry.evader.actor) for i in range(how.seeds)]
    found = [fly(network) for network in [*networks, None]]
    seconds = np.stack([np.asarray(s.capture_step) * settings.time_step for s in found])
    captured = np.stack([np.asarray(s.captured) for s in found])
    return seconds, captured, tasks


def study(options) -> dict:
    """Values of the planar games, captures by stack."""
    how = BestResponseSettings(total_steps=options.steps, seeds=3, num_envs=options.worlds, layouts=0.0)
    records, against_stack = [], []
    for name, number, speed, grid in (
        ("one against one", 1, 0.8, (options.fine, 2 * options.fine + 1)),
        ("two against one", 2, 1.1, (options.coarse, 2 * options.coarse + 1)),
    ):
        settings = game(num_pursuers=number, evader_speed=speed, max_speed=1.0)
        environment = Planar(settings, dynamics=Points(settings.max_speed, settings.time_step))
        seconds, captured, tasks = learn(environment, Straight(), how)
        table = exact(settings, *grid, iterations=int(8.0 / STEP))
        values = look_up(table, np.asarray(tasks.evader_position), np.asarray(tasks.pursuer_position))
        records.append(
            {
                "game": name,
                "evader_speed": speed,
                "exact": float(values.mean()),
                "learned": [float(s.mean()) for s in seconds[:-1]],
                "share_of_exact": [float(s.mean() / values.mean()) for s in seconds[:-1]],
                "greedy": float(seconds[-1].mean()),
                "captured": [float(c.mean()) for c in captured],
            }
        )
    for radius in (0.3, 0.27):
        settings = game(capture_radius=radius)
        environment = Pursuit(settings, dynamics=Points(settings.max_speed, settings.time_step))
        craft = dataclasses.replace(Craft.of(environment), speed=settings.max_speed, response=0.0)
        seconds, captured, _ = learn(environment, Stack(craft), how)
        record = {"capture_radius": radius, "bound": stack_bound(settings), "ratio": settings.evader_speed}
        record |= {
            "captured": [float(c.mean()) for c in captured[:-1]],
            "captured_greedy": float(captured[-1].mean()),
            "slowest": [float(s.max()) for s in seconds[:-1]],
        }
        against_stack.append(record)
    return {"planar": records, "stack": against_stack, "steps": options.steps}


def page(results: dict) -> Page:
    """Both tables."""
    columns = {
        "game": "game",
        "evader's speed, m/s": "evader_speed",
        "exact, s": "exact:.3f",
        "learned, s (three seeds)": lambda row: ", ".join(f"{x:.3f}" for x in row["learned"]),
        "share of the exact": lambda row: ", ".join(f"{x:.3f}" for x in row["share_of_exact"]),
        "greedy, s": "greedy:.3f",
    }
    of_stack = {
        "capture radius, m": "capture_radius",
        "bound of v_e / v_p": "bound:.3f",
        "v_e / v_p": "ratio:.3f",
        "captured, learned (three seeds)": lambda row: ", ".join(f"{x:.4f}" for x in row["captured"]),
        "captured, greedy": "captured_greedy:.4f",
        "slowest capture, s": lambda row: ", ".join(f"{x:.2f}" for x in row["slowest"]),
    }
    prose = (
        f"Mean time to the capture over 2,048 uniform starts; {results['steps'] / 1e6:.0f} M steps a seed."
    )
    parts = [
        Table(columns, results["planar"], title="Planar games"),
        Table(of_stack, results["stack"], title="Stack"),
    ]
    return Page("The learned evader where the truth is known", prose, parts)


def main(arguments: list[str]) -> int:
    """Learn, solve, write both files."""
    parser = page_parser(__doc__, "evaders_planar")
    parser.add_argument("--steps", type=int, default=20_000_000)
    parser.add_argument("--worlds", type=int, default=2048)
    parser.add_argument("--fine", type=int, default=46, help="radii of the grid of one against one")
    parser.add_argument("--coarse", type=int, default=19, help="radii of the grid of two against one")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
