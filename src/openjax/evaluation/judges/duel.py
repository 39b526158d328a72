"""A policy against an evader that is told where to fly."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState, Task

World = tuple[Observation, PursuitState]
"""Worlds (B, ...) on their way."""


@dataclass(frozen=True, eq=False)
class Duel:
    """A game, and the policy whose mean flies its pursuers."""

    environment: Pursuit
    policy: Policy

    def start(self, tasks: Task, key: jax.Array) -> World:
        """Worlds at the start of tasks (B, ...)."""
        keys = jax.random.split(key, tasks.evader_position.shape[0])
        return jax.vmap(self.environment.reset_to)(keys, tasks)

    def fly(
        self, parameters: PolicyParameters, world: World, velocity: jax.Array, steps: int
    ) -> World:
        """Worlds (B, ...) after control steps in which the evader flies `velocity` (B,
        3), as shares of its speed in the world's axes.
        """

        def act(observation, state):
            return self.policy.act(parameters, observation)

        return self.fly_actions(act, world, velocity, steps)

    def fly_actions(
        self,
        act: Callable[[Observation, PursuitState], jax.Array],
        world: World,
        velocity: jax.Array,
        steps: int,
    ) -> World:
        """The same with pursuers that do what `act` says: (B, N, 4) of worlds (B,
        ...).
        """
        # a game of the library draws nothing after its reset
        key = jax.random.key(0)
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0, 0))

        def one(world, _):
            observation, state, *_ = step(key, world[1], act(*world), velocity)
            return (observation, state), None

        return jax.lax.scan(one, world, length=steps)[0]


def copies(world: World, number: int) -> World:
    """(number * B, ...): all worlds (B, ...) again and again."""

    def tile(leaf):
        return jnp.tile(leaf, (number, *[1] * (leaf.ndim - 1)))

    return jax.tree.map(tile, world)
