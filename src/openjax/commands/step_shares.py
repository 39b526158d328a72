"""Where the time of a training step goes, and what a limit would be: its parts compiled and timed each on its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from rich.table import Table

from openjax.learning import TrainSettings, build, init_carry, make_training_step
from openjax.learning.rollout import collect
from openjax.learning.training_step import make_phases
from openjax.pursuit.environment import action_to_command
from openjax.show.number_tables import numbers_table

BANDWIDTH = 4.3e12
"""Bytes per second that an NVIDIA H200 was measured to read or write at best ..."""
ARITHMETIC = 790e12
"""... and floating-point operations per second of its matrix units in bfloat16."""


@dataclass(frozen=True)
class Share:
    """One part of a training step."""

    part: str
    seconds: float
    flops: float
    """Arithmetic of the matrix products that it can't do without."""
    bytes: float
    """Bytes that it can't avoid to read or write."""

    @property
    def limit(self) -> float:
        """Seconds that arithmetic or memory of an H200 would need."""
        return max(self.flops / ARITHMETIC, self.bytes / BANDWIDTH)


def measure(settings: TrainSettings, seconds_of: Callable[[Callable, tuple], float | None]) -> list[Share]:
    """Parts of the training step, of which the last is the whole; empty if one of them runs out of memory.

    `seconds_of` times a function of arrays. What only shows inside a larger part is the difference of two measurements:
    game = environment - physics, policy = rollout - environment - prediction, rest = step - all of these.
    """
    carry = init_carry(settings, jax.random.key(0))
    seconds = {name: seconds_of(*program) for name, program in _programs(settings, carry).items()}
    if None in seconds.values():
        return []
    predicted = seconds.get("prediction", 0.0)
    seconds["rest (tasks, resets, noise)"] = seconds["step"] - sum(
        value
        for name, value in seconds.items()
        if name in ("rollout", "predictor's update", "policy's update")
    )
    seconds["policy"] = seconds.pop("rollout") - seconds["environment"] - predicted
    seconds["game"] = seconds.pop("environment") - seconds["physics"]
    work = _work(settings, carry)
    work["step"] = tuple(map(sum, zip(*(work[name] for name in seconds if name in work), strict=True)))
    order = [
        *(name for name in work if name in seconds and name != "step"),
        "rest (tasks, resets, noise)",
        "step",
    ]
    return [Share(name, seconds[name], *work.get(name, (0.0, 0.0))) for name in order]


def _programs(settings, carry) -> dict[str, tuple[Callable, tuple]]:
    """What is timed: functions and their arguments."""
    parts, steps = build(settings), settings.rollout_length
    environment, policy = parts.environment, parts.policy
    shape = (steps, settings.num_envs, settings.environment.num_pursuers)
    noise = jax.random.normal(jax.random.key(1), (*shape, policy.sample_size))
    actions = jnp.tanh(jax.random.normal(jax.random.key(1), (*shape, 4)))

    def physics(state, actions):
        move = jax.vmap(environment.dynamics, (None, 0, 0, 0, 0, 0 if state.vehicles else None))
        pillars = (state.task.pillar_position, state.task.pillar_active)
        effects = {**state.vehicles, **environment.effect_parameters}

        def one(drones, action):
            return move(environment.vehicle, drones, action_to_command(action), *pillars, effects), None

        return jax.lax.scan(one, state.drones, actions)[0]

    def game(state, actions):
        def one(state, action):
            step = jax.vmap(environment.step, (None, 0, 0))
            observation, state, reward, *_ = step(jax.random.key(0), state, action)
            return state, (observation.replace(frames=observation.frames[:, -1:]), reward)

        return jax.lax.scan(one, state, actions)

    def rollout(carry, noise):
        return collect(environment, policy, carry.policy, carry.observation, carry.state, noise)

    def prediction(carry):
        def one(shift, _):
            # shifted a little each time, so that the loop can't be taken apart
            seen = carry.observation.replace(last_seen=carry.observation.last_seen + shift)
            predicted = policy.predict(carry.policy, seen)
            return 1e-6 * jnp.mean(predicted), predicted

        return jax.lax.scan(one, jnp.zeros(()), None, length=steps)

    phases = make_phases(settings)
    _, flown, _ = jax.jit(phases.fly)(carry)
    programs = {
        "physics": (physics, (carry.state, actions)),
        "environment": (game, (carry.state, actions)),
        "rollout": (rollout, (carry, noise)),
        "policy's update": (phases.learn[-1], (carry, flown)),
        "step": (make_training_step(settings), (carry,)),
    }
    if settings.predictor.enabled:
        programs |= {
            "prediction": (prediction, (carry,)),
            "predictor's update": (phases.learn[0], (carry, flown)),
        }
    return programs


def _work(settings, carry) -> dict[str, tuple[float, float]]:
    """Operations of the matrix products that a part can't do without, and bytes that it can't avoid to read or write."""
    steps, worlds = settings.rollout_length, settings.num_envs
    samples = worlds * settings.environment.num_pursuers * steps
    acting, judging = (2 * products(settings, own) for own in (carry.policy.actor, carry.policy.critic))
    history = settings.environment.history_length
    predicting = 2 * history * sum(x.size for x in jax.tree.leaves(carry.policy.predictor))
    observed, frames = _bytes(carry.observation.replace(frames=())) * steps, _bytes(carry.observation.frames)
    windows, update = settings.predictor.windows, settings.mappo.epochs / settings.mappo.step_subsampling
    moved = (
        2 * steps * _bytes(carry.state.drones),
        2 * steps * _bytes(carry.state.replace(drones=(), task=())),
    )
    return {
        "physics": (0.0, moved[0]),
        "game": (0.0, moved[1] + observed),
        "policy": (acting * samples, 2 * observed),
        "prediction": (predicting * worlds * steps, frames * steps),
        "predictor's update": (3 * predicting * windows * worlds, frames * windows),
        "policy's update": ((3 * update + 1) * (acting + judging) * samples, (update + 1) * observed),
    }


def _bytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def products(settings: TrainSettings, parameters: Any) -> int:
    """Multiplications of one sample in a network's matrix products, its attention with keys and values folded."""
    network, game = settings.network, settings.environment
    uses = {"others_kernel": game.num_pursuers - 1, "pillars_kernel": game.observed_pillars}
    # query and output are as wide as an embedding for each head, keys and values are folded into them
    uses |= {"query": network.heads, "output": network.heads, "key": 0, "value": 0}
    total, attends = 0, False
    for path, leaf in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = path[-1].key
        attends |= name == "query"
        if leaf.ndim == 2 and (name == "kernel" or name in uses):
            total += math.prod(leaf.shape) * uses.get(name, 1)
    entities = game.num_pursuers + game.observed_pillars
    return total + (2 * network.heads * entities * network.features if attends else 0)


def shares_table(shares: list[Share], settings: TrainSettings) -> Table:
    """Parts of the step as a table; the limit is an H200's, and a CPU is spared it."""
    on_cpu = jax.default_backend() == "cpu"
    speed = settings.steps_per_update / shares[-1].seconds
    title = f"Where a training step's time goes: {settings.num_envs:,} worlds, {speed:,.0f} env steps/s"
    caption = f"limit: {BANDWIDTH / 1e12:.1f} TB/s, {ARITHMETIC / 1e12:.0f} TFLOP/s (H200) for what must be moved or multiplied"
    heads = ("ms", "share", "GFLOP", "GB", *([] if on_cpu else ["limit [ms]"]))
    table = numbers_table(title, "part", *heads, caption=None if on_cpu else caption)
    for share in shares:
        table.add_row(
            share.part,
            f"{share.seconds * 1e3:,.2f}",
            f"{share.seconds / shares[-1].seconds:.0%}",
            f"{share.flops / 1e9:,.1f}",
            f"{share.bytes / 1e9:,.2f}",
            *([] if on_cpu else [f"{share.limit * 1e3:,.2f}"]),
        )
    return table
