"""Evaders that learn, where the best response is known: `python -m
tests.learning.known_games [--radius M] [--defaults]`.

Stack with a capture radius forces a capture inside its bound and not outside. Without
one: two points that fly straight at a slower evader in a wide plane; what it can reach
at the best is an optimal control problem, solved from each start by itself. Prints a
record.
"""

import argparse
import functools
import json

import jax
import jax.numpy as jnp

from openjax.baselines.surroundings import length
from openjax.evaluation.judges.best_response import BestResponse, fly_learners
from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.settings import BestResponseSettings
from openjax.pursuit import Pursuit, PursuitSettings, Task, uniform_task
from tests.learning.points import Team, game_of_points, stack_team

STARTS = 128
SIZES = {
    "learners": 3,
    "num_envs": 32,
    "widths": (64,),
    "minibatches": 4,
    "foresight": (4.0,),
    # of a narrower network, Adam's steps move the output less
    "learning_rate": 2e-3,
}
"""For two cores: what counts is the number of updates, and less is sensed here than in
the game.
"""


def learn(environment: Pursuit, team: Team, draw, steps: int, **changes):
    """Statistics (L, STARTS) of the L evaders that learned, and the starts, which
    `draw` (key -> Task) gave to none of them before. `steps` are each learner's.
    """
    sizes = {"learners": SIZES["learners"]} if changes.pop("defaults", False) else SIZES
    settings = sizes | changes
    settings = BestResponseSettings(total_steps=settings["learners"] * steps, **settings)
    duel = Duel(environment, team)
    response = BestResponse(settings, duel, draw)
    carry = jax.jit(response.start)(jax.random.key(7))
    step = jax.jit(response.step, donate_argnums=1)
    for _ in range(settings.total_updates):
        # a CPU with dozens under way waits for ever
        carry, _ = jax.block_until_ready(step({}, carry))
    tasks = jax.vmap(draw)(jax.random.split(jax.random.key(1), STARTS))
    fly = jax.jit(functools.partial(fly_learners, duel, settings.hold))
    return fly(carry.evaders, {}, duel.start(tasks, jax.random.key(3)))[0], tasks


def against_stack(radius: float, steps: int, **changes) -> dict:
    """Captures by stack with this radius (m) within 4 s."""
    environment = game_of_points(evaders=("field",), capture_radius=radius, episode_length=400)

    def draw(key):
        task = uniform_task(environment.settings, key)
        return task.replace(pillar_active=jnp.zeros_like(task.pillar_active))

    learned, _ = learn(environment, stack_team(environment), draw, steps, **changes)
    return {"radius": radius, "steps": steps, "learned": learned.captured.mean(-1).tolist()}


def straight(observation):
    """At the evader."""
    to_evader = -observation.self_state[..., :3]
    return to_evader / length(to_evader)


def two_against_one(steps: int, **changes) -> dict:
    """Mean seconds to the capture, as a share of the longest possible ones."""
    environment = game_of_points(
        num_pursuers=2,
        max_speed=1.0,
        evader_speed=0.8,
        arena_radius=10.0,
        arena_height=10.0,
        evaders=("field",),
        episode_length=248,
    )
    settings = environment.settings
    learned, starts = learn(environment, Team(straight), draw_between, steps, **changes)
    apart = starts.pursuer_position - starts.evader_position[:, None]
    exact = longest(settings, apart[..., :2])
    seconds = learned.capture_step * settings.time_step
    share = (seconds / exact).mean(-1).tolist()
    return {"steps": steps, "exact": float(exact.mean()), "learned": share}


def draw_between(key) -> Task:
    """An evader between two pursuers, one nearer than the other, in the plane at half
    the height.
    """
    low = jnp.array([0.5, 0.9, -0.5, -1.0])
    high = jnp.array([0.8, 1.5, 0.5, 1.0])
    near, far, one, other = jax.random.uniform(key, (4,), minval=low, maxval=high)
    angle = jnp.array([one, jnp.pi + other])
    level = jnp.array([near, far])[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    middle = jnp.array([0.0, 0.0, 5.0])
    pursuers = middle + jnp.pad(level, ((0, 0), (0, 1)))
    return Task(pursuers, middle, jnp.zeros((1, 2)), jnp.zeros(1, bool))


def longest(
    settings: PursuitSettings, pursuers: jax.Array, knots: int = 8, samples: int = 128
) -> jax.Array:
    """(B,) seconds for which an evader can keep away from `straight` ones at (B, N, 2)
    from it, by the cross-entropy method.

    The headings lie on lines between knots. More knots, samples and rounds gave the
    same within a time step, and so does the closed form (d - r) / (v_p - v_e) of one
    pursuer.
    """
    steps = settings.episode_length
    dt = settings.time_step
    stride = settings.max_speed * dt
    reach = settings.evader_speed * dt

    def fly(pursuers, at_knots):
        heading = jnp.interp(jnp.linspace(0.0, knots - 1.0, steps), jnp.arange(knots), at_knots)

        def one(world, heading):
            evader, pursuers, free = world
            to_evader = evader - pursuers
            pursuers = pursuers + stride * to_evader / length(to_evader)
            evader = evader + reach * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
            free &= jnp.all(length(evader - pursuers) >= settings.capture_radius)
            return (evader, pursuers, free), free

        kept = jax.lax.scan(one, (jnp.zeros(2), pursuers, jnp.ones((), bool)), heading)[1]
        return dt * (1 + jnp.sum(kept))

    def solve(key, pursuers):
        def improve(normal, key):
            tried = normal[0] + normal[1] * jax.random.normal(key, (samples, knots))
            found = jax.vmap(fly, (None, 0))(pursuers, tried)
            best = tried[jnp.argsort(-found)[: samples // 8]]
            return (best.mean(0), 0.8 * best.std(0) + 0.2 * normal[1]), jnp.max(found)

        ways = 2 * jnp.pi * jnp.arange(64) / 64
        way = ways[jnp.argmax(jax.vmap(lambda way: fly(pursuers, jnp.full(knots, way)))(ways))]
        normal = jnp.full(knots, way), jnp.full(knots, 0.5)
        return jnp.max(jax.lax.scan(improve, normal, jax.random.split(key, 20))[1])

    keys = jax.random.split(jax.random.key(0), len(pursuers))
    return jax.jit(lambda: jax.lax.map(lambda own: solve(*own), (keys, pursuers), batch_size=8))()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--radius", type=float, help="of a capture by stack, m")
    parser.add_argument("--steps", type=int, default=8_000_000, help="of each seed")
    parser.add_argument(
        "--defaults", action="store_true", help="an accelerator's: those of `openjax exploit`"
    )
    changes = {"seeds": "learners", "worlds": "num_envs"}
    for name in ("seeds", "worlds", "ways", "minibatches", "epochs", "learning_rate"):
        setting = changes.get(name, name)
        kind = float if name == "learning_rate" else int
        parser.add_argument(f"--{name}", dest=setting, type=kind, default=argparse.SUPPRESS)
    options = vars(parser.parse_args())
    radius = options.pop("radius")
    play = two_against_one if radius is None else functools.partial(against_stack, radius)
    print(json.dumps(play(**options)))
