"""The learning evader against exact values: `python -m experiments.evaders.planar [--steps 20000000]`.

Points in a disc without pillars; each pursuer flies straight at the evader. What the evader can reach is then an optimal control
problem, solved on a grid by value iteration (time to the capture, at most 8 s). Beside it, from the same starts: the evader that
`openjax exploit` would learn, and the greedy one. And stack, inside and outside the bound of its theorem. Writes
experiments/results/evaders_planar.json and .md.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates

from experiments.table import Page, Table, page_parser, publish
from openjax.baselines.stack import Points, StackParameters, stack, stack_bound
from openjax.baselines.surroundings import Craft, surroundings
from openjax.commands.command_line import run_command
from openjax.learning.best_response import BestResponse, make_duel
from openjax.learning.best_response_settings import BestResponseSettings
from openjax.pursuit import Pursuit, PursuitSettings, empty_task, uniform_task
from openjax.pursuit.evaders.behaviours import MARGIN

STEP = 0.04
"""Seconds of a step of the value iteration."""
HEADINGS = 32
SEEDS = 3


class Empty(Pursuit):
    """The game without pillars."""

    def reset_to(self, key, task):
        """As `Pursuit.reset_to`."""
        return super().reset_to(key, task.replace(pillar_active=jnp.zeros_like(task.pillar_active)))


class Planar(Empty):
    """The game in which nobody leaves the plane at half the arena's height."""

    def reset_to(self, key, task):
        """As `Pursuit.reset_to`, with all starts in the plane."""
        height = self.settings.arena_height / 2
        pursuers, evader = (x.at[..., 2].set(height) for x in (task.pursuer_position, task.evader_position))
        return super().reset_to(key, task.replace(pursuer_position=pursuers, evader_position=evader))

    def step(self, key, state, action, wish=None):
        """As `Pursuit.step`, with a wish in the plane."""
        return super().step(key, state, action, None if wish is None else wish.at[2].set(0.0))


@dataclasses.dataclass(frozen=True)
class Team:
    """Pursuers for `Points`, by a function from observations to velocities (..., N, 3) as shares of the speed."""

    velocity: Callable

    def act(self, parameters, observation):
        """(..., N, 4): no thrust, a velocity."""
        velocity = self.velocity(observation)
        return jnp.concatenate([jnp.zeros_like(velocity[..., :1]), velocity], axis=-1)


def straight(observation):
    """At the evader."""
    to_evader = -observation.self_state[..., :3]
    return to_evader / jnp.sqrt(jnp.sum(to_evader**2, axis=-1, keepdims=True) + 1e-12)


def stack_of(craft: Craft):
    """Stack, by a function like `straight`."""
    how = StackParameters(0.05, 100.0)
    return lambda seen: stack(craft, how, surroundings(craft, seen)) / craft.speed


def game(**changes) -> PursuitSettings:
    """Points in an arena without pillars."""
    fixed = dict(physics="stops", speed_limit="none", evaders=("learned",) * SEEDS, min_pillars=0)
    return PursuitSettings(**fixed, max_pillars=1, **changes)


def _places(radii, angles, evader, pursuers):
    """Places (1 + 2 N, B) on the grid of (evader's radius, each pursuer's radius, its angle from the evader's), of (B, 2) and
    (B, N, 2) in units of the arena's radius."""
    turn = jnp.arctan2(evader[:, 1], evader[:, 0])[:, None]
    angle = jnp.mod(jnp.arctan2(pursuers[..., 1], pursuers[..., 0]) - turn + jnp.pi, 2 * jnp.pi)
    radius = jnp.linalg.norm(jnp.concatenate([evader[:, None], pursuers], axis=1), axis=-1)
    return jnp.concatenate([radius * (radii - 1), angle / (2 * jnp.pi) * (angles - 1)], axis=1).T


def exact(settings: PursuitSettings, radii: int, angles: int) -> Callable:
    """`value(evader (B, 2), pursuers (B, N, 2))`: seconds to the capture under the best evader, by value iteration on a grid."""
    n, size = settings.num_pursuers, settings.arena_radius
    axes = [jnp.linspace(0.0, size, radii)] * (1 + n) + [jnp.linspace(-jnp.pi, jnp.pi, angles)] * n
    grid = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1)
    shape, grid = grid.shape[:-1], grid.reshape(-1, 1 + 2 * n)
    evader = jnp.stack([grid[:, 0], jnp.zeros_like(grid[:, 0])], axis=-1)
    r, angle = grid[:, 1 : 1 + n], grid[:, 1 + n :]
    pursuers = jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle)], axis=-1)
    heading = 2 * jnp.pi * jnp.arange(HEADINGS) / HEADINGS
    moves = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1) * settings.evader_speed * STEP

    def caught(evader, pursuers):
        return jnp.any(jnp.linalg.norm(evader[:, None] - pursuers, axis=-1) < settings.capture_radius, -1)

    towards = evader[:, None] - pursuers
    gap = jnp.linalg.norm(towards, axis=-1, keepdims=True) + 1e-9
    # the game's pursuers know where the evader is now, and not where it goes
    closer = pursuers + towards / gap * jnp.minimum(gap, settings.max_speed * STEP)

    def improve(_, value):
        def best(so_far, move):
            moved = evader + move
            radius = jnp.linalg.norm(moved, axis=-1, keepdims=True) + 1e-9
            moved = moved * jnp.minimum(1.0, (size - MARGIN) / radius)
            where = _places(radii, angles, moved / size, closer / size)
            later = map_coordinates(value, list(where), order=1, mode="nearest")
            return jnp.maximum(so_far, jnp.where(caught(moved, closer), 0.0, later)), None

        later = jax.lax.scan(best, jnp.zeros(grid.shape[0]), jnp.concatenate([moves, jnp.zeros((1, 2))]))[0]
        return jnp.where(caught(evader, pursuers), 0.0, jnp.minimum(STEP + later, most)).reshape(shape)

    most = settings.episode_length * settings.time_step
    value = jax.jit(lambda: jax.lax.fori_loop(0, round(most / STEP), improve, jnp.zeros(shape)))()
    return lambda evader, pursuers: map_coordinates(
        value, list(_places(radii, angles, evader / size, pursuers / size)), order=1, mode="nearest"
    )


def learn(environment: Pursuit, team: Team, how: BestResponseSettings):
    """Tasks (B, ...), and seconds to the capture and captures (S + 1, B) of the learned evaders and of the greedy one."""
    settings = environment.settings
    layouts = jax.tree.map(lambda leaf: leaf[None], empty_task(settings))
    response = BestResponse(how, environment, team, layouts)
    carry = jax.jit(response.start)(jax.random.key(0))
    step = jax.jit(response.step, donate_argnums=1)
    for _ in range(how.total_updates):
        # one at a time: a CPU with dozens of them under way waits for ever
        carry, _ = jax.block_until_ready(step({}, carry))
    keys = jax.random.split(jax.random.key(77), how.num_envs)
    tasks = jax.vmap(lambda key: uniform_task(settings, key))(keys)
    networks = [
        jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], carry.evaders.actor) for i in range(how.seeds)
    ]
    duel, kinds = jax.jit(make_duel(environment, team)), jnp.zeros(how.num_envs, jnp.int32)
    # without a network it is the greedy one
    found = [duel({}, tasks, kinds, keys[0], {"evader_networks": own}) for own in [*networks, None]]
    seconds = np.stack([np.asarray(s.capture_step) for s in found]) * settings.time_step
    return tasks, seconds, np.stack([np.asarray(s.captured) for s in found])


def study(options) -> dict:
    """Values of the planar games, captures by stack."""
    how = BestResponseSettings(total_steps=options.steps, seeds=SEEDS, num_envs=options.worlds, layouts=0.0)
    planar, against_stack = [], []
    for number in options.pursuers:
        speed, radii = (0.8, 1.1)[number - 1], options.radii[number - 1]
        settings = game(num_pursuers=number, evader_speed=speed, max_speed=1.0)
        environment = Planar(settings, dynamics=Points(settings.max_speed, settings.time_step))
        tasks, seconds, _ = learn(environment, Team(straight), how)
        value = exact(settings, radii, 2 * radii + 1)
        best = float(value(tasks.evader_position[:, :2], tasks.pursuer_position[..., :2]).mean())
        *learned, greedy = (float(s.mean()) for s in seconds)
        record = {"pursuers": number, "evader_speed": speed, "exact": best, "greedy": greedy}
        planar.append(record | {"learned": learned, "share": [own / best for own in learned]})
    for radius in (0.3, 0.27):
        settings = game(capture_radius=radius)
        environment = Empty(settings, dynamics=Points(settings.max_speed, settings.time_step))
        craft = dataclasses.replace(Craft.of(environment), speed=settings.max_speed, response=0.0)
        _, seconds, captured = learn(environment, Team(stack_of(craft)), how)
        *learned, greedy = (float(c.mean()) for c in captured)
        record = {"capture_radius": radius, "bound": stack_bound(settings), "ratio": settings.evader_speed}
        slowest = [float(s.max()) for s in seconds[:-1]]
        against_stack.append(record | {"learned": learned, "greedy": greedy, "slowest": slowest})
    return {"planar": planar, "stack": against_stack, "steps": options.steps, "starts": options.worlds}


def page(results: dict) -> Page:
    """Both tables."""
    of_planar = {
        "pursuers": "pursuers",
        "evader's speed, m/s": "evader_speed",
        "exact, s": "exact:.3f",
        "learned, s": "learned:.3f",
        "share of the exact": "share:.3f",
        "greedy, s": "greedy:.3f",
    }
    of_stack = {
        "capture radius, m": "capture_radius",
        "bound of v_e / v_p": "bound:.3f",
        "v_e / v_p": "ratio:.3f",
        "captured, learned": "learned:.4f",
        "captured, greedy": "greedy:.4f",
        "slowest capture, s": "slowest:.2f",
    }
    tables = [Table(of_planar, results["planar"], "Planar games"), Table(of_stack, results["stack"], "Stack")]
    prose = (
        f"Mean time to the capture over {results['starts']:,} uniform starts, at most 8 s. Of the evaders that learned "
        f"{results['steps'] / 1e6:g} M steps: mean (standard deviation) of three seeds."
    )
    return Page("The learned evader where the truth is known", prose, tables)


def main(arguments: list[str]) -> int:
    """Learn, solve, write both files."""
    parser = page_parser(__doc__, "evaders_planar")
    parser.add_argument("--steps", type=int, default=20_000_000)
    parser.add_argument("--worlds", type=int, default=2048)
    parser.add_argument(
        "--pursuers", nargs="+", type=int, choices=(1, 2), default=[1, 2], help="planar games"
    )
    parser.add_argument("--radii", nargs=2, type=int, default=[46, 19], help="of the grids, by pursuers")
    publish(parser.parse_args(arguments), study, page)
    return 0


if __name__ == "__main__":
    run_command(main)
