"""Capture radius and evader speed: `python experiments/sweeps.py [--policy NAME|PATH ...] [--episodes 100]`.

Evaluates policies, trained at one radius and one speed, at others on the six layouts, as the paper's two sweeps do in `empty` and
`passage`. All speeds and layouts fly in one compiled call; the radius changes nothing but what counts as a capture, so each
flight tells it for all radii. Writes experiments/results/sweeps.json, .md and .png; `--report` writes the last two again.
"""

import argparse
import copy
import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from headline import shipped_with_clamp
from pages import page_parser, publish
from prediction_flights import layout_tasks
from sweeps_report import draw, report

from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots
from openjax.commands.machine import describe_machine
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, Task
from openjax.pursuit.reward import captures
from openjax.store.policies import load_policy
from openjax.store.settings_files import to_plain

RADII = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
SPEEDS = (1.0, 1.3, 1.6, 2.0, 2.4, 2.8)


@dataclasses.dataclass(frozen=True)
class SweptSettings(PursuitSettings):
    """Settings with a traced evader speed, so that one compiled function serves all."""

    def __post_init__(self):
        """A traced number can't be checked; those swept over are positive."""


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def sweep(
    environment: Pursuit,
    policy: Policy,
    radii: tuple[float, ...],
    parameters: PolicyParameters,
    tasks: Task,
    speeds: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """One episode of the mean policy per task.

    Args:
        environment: the game at its own radius and speed.
        policy: the networks.
        radii: (R,) capture radii (m).
        parameters: the policy's.
        tasks: leading axis B.
        speeds: (B,) m/s, of the evader.
        key: of the start attitudes.

    Returns:
        (B, R) first step with a capture within each radius, episode length + 1 where there is none; and (B, 2)
        collision rate and whether any pursuer crashed.
    """
    settings = environment.settings
    plain = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    never = settings.episode_length + 1

    def step(state, action, speed):
        swept = copy.copy(environment)
        swept.settings = SweptSettings(**{**plain, "evader_speed": speed})
        return swept.step(jax.random.key(0), state, action)[:2]

    def caught(state):
        each = [
            captures(
                dataclasses.replace(settings, capture_radius=radius),
                state.drones.position,
                state.evader_position,
                state.in_sight,
            )
            for radius in radii
        ]
        return jnp.any(jnp.stack(each), axis=-1)

    def one(carry, _):
        observation, state, first = carry
        observation, state = jax.vmap(step)(state, policy.act(parameters, observation), speeds)
        now = jnp.where(jax.vmap(caught)(state), state.step[:, None], never)
        return (observation, state, jnp.minimum(first, now)), None

    keys = jax.random.split(key, speeds.shape[0])
    observation, state = jax.vmap(environment.reset_to)(keys, tasks)
    first = jnp.full((speeds.shape[0], len(radii)), never, jnp.int32)
    start = (observation, state, first)
    (_, state, first), _ = jax.lax.scan(one, start, length=settings.episode_length)
    counted = state.statistics
    return first, jnp.stack([counted.collision_rate, counted.crashed.astype(jnp.float32)], axis=-1)


def of_policy(name: str, episodes: int, changes: dict) -> dict:
    """Figures of one policy by layout, speed and radius."""
    loaded = load_policy(name)
    settings = dataclasses.replace(loaded.settings.environment, **changes)
    settings = dataclasses.replace(settings, max_pillars=layout_slots(settings))
    number = len(SCENARIOS) * episodes
    tasks = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(SPEEDS)), layout_tasks(settings, episodes))
    first, counted = sweep(
        _environment(settings),
        loaded.policy,
        RADII,
        loaded.parameters,
        tasks,
        jnp.repeat(jnp.array(SPEEDS, jnp.float32), number),
        jax.random.key(0),
    )
    shape = (len(SPEEDS), len(SCENARIOS), episodes, -1)
    first, counted = (np.asarray(leaf, float).reshape(shape).swapaxes(0, 1) for leaf in (first, counted))
    missed = first > settings.episode_length
    return {
        "policy": name,
        "settings": to_plain(loaded.settings),
        # (layouts, speeds, radii)
        "capture_rate": np.round(1 - missed.mean(axis=2), 5).tolist(),
        "capture_step": np.round(np.where(missed, settings.episode_length, first).mean(axis=2), 2).tolist(),
        # (layouts, speeds)
        "collision_rate": np.round(counted[..., 0].mean(axis=2), 6).tolist(),
        "crash_rate": np.round(counted[..., 1].mean(axis=2), 5).tolist(),
    }


@functools.cache
def _environment(settings):
    """The same object for the same game: what is compiled is found again by it."""
    return Pursuit(settings)


def study(options: argparse.Namespace) -> dict:
    """Fly every policy over all radii and speeds."""
    started = time.monotonic()
    changes = {"speed_limit": options.speed_limit}
    policies = [of_policy(name, options.episodes, changes) for name in options.policy or shipped_with_clamp()]
    shown = f" --policy {' '.join(options.policy)}" if options.policy else ""
    shown += "" if options.speed_limit == "clamp" else f" --speed-limit {options.speed_limit}"
    return {
        "command": f"python experiments/sweeps.py{shown} --episodes {options.episodes}",
        "commit": options.commit,
        "note": options.note,
        "machine": describe_machine(),
        "seconds": time.monotonic() - started,
        "episodes": options.episodes,
        "speed_limit": options.speed_limit,
        "layouts": list(SCENARIOS),
        "speeds": SPEEDS,
        "radii": RADII,
        "policies": policies,
    }


def main(arguments: list[str]) -> int:
    """Sweep or read it, write the three files, print the page."""
    parser = page_parser(__doc__, "sweeps")
    parser.add_argument(
        "--policy", nargs="+", help="by default all that ship and were trained with the clamp"
    )
    parser.add_argument("--episodes", type=int, default=100, help="per layout and speed")
    parser.add_argument("--speed-limit", choices=("clamp", "none"), default="clamp")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    parser.add_argument("--note", default="")
    publish(parser.parse_args(arguments), study, report, draw)
    return 0


if __name__ == "__main__":
    run_command(main)
