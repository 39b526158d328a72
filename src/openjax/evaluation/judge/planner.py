"""An evader that plans in the true simulation against the true policy, with a receding horizon.

Every few steps it tries plans, sequences of held velocities, in copies of its world, in which the
policy answers as it will; it flies the beginning of the best one. It needs no learning, so it
doesn't share the learner's blind spots: a learner that is caught sooner than the planner on the
same tasks has not converged.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from openjax.evaluation.judge.learner import fly_decision
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import EpisodeStatistics, Observation, Pursuit, PursuitState, Task


@dataclass(frozen=True)
class PlannerSettings:
    """How the planner plans."""

    plans: int = 48
    """That are tried each time."""
    pieces: int = 4
    """Velocities of a plan, one after the other."""
    hold: int = 20
    """Control steps of each velocity: .2 s, so that four see .8 s ahead."""
    replan: int = 10
    """Control steps after which it plans anew; divides the episode's length and `hold`."""
    ahead: float = 0.15
    """Seconds after which pursuers are thought to be where their velocity leads, at a plan's end:
    about the time in which a vehicle turns its velocity round.
    """


@dataclass(frozen=True, eq=False)
class Planner:
    """The planner against a policy's mean."""

    settings: PlannerSettings
    environment: Pursuit
    policy: Policy

    def fly(
        self, parameters: PolicyParameters, tasks: Task, key: jax.Array
    ) -> EpisodeStatistics:
        """Statistics (B,) of one episode on each of B tasks."""
        number = tasks.evader_position.shape[0]
        key, reset_key = jax.random.split(key)
        reset = jax.vmap(self.environment.reset_to)
        world = reset(jax.random.split(reset_key, number), tasks)
        plan = jnp.zeros((number, self.settings.pieces, 3))
        length = self.environment.settings.episode_length

        def one(carry, key):
            world, plan = carry
            plan = self._best(parameters, world, plan, key)
            world = fly_decision(
                self.environment, self.policy, parameters, world, plan[:, 0], self.settings.replan
            )
            return (world, plan), None

        keys = jax.random.split(key, length // self.settings.replan)
        (_, state), _ = jax.lax.scan(one, (world, plan), keys)[0]
        return state.statistics

    def _best(self, parameters, world, plan, key):
        """(B, pieces, 3) the plan of those tried that promises most in each world (B, ...)."""
        number = plan.shape[0]
        tried = self._candidates(key, plan)  # (B, M, pieces, 3)

        def copies(leaf):
            return jnp.repeat(leaf, self.settings.plans, axis=0)

        copied = jax.tree.map(copies, world)
        pieces = jnp.moveaxis(tried.reshape(-1, *tried.shape[2:]), 1, 0)

        def piece(world, wish):
            flown = fly_decision(
                self.environment, self.policy, parameters, world, wish, self.settings.hold
            )
            return flown, None

        (_, end), _ = jax.lax.scan(piece, copied, pieces)
        score = jax.vmap(self._promise)(world_states(copied), end).reshape(number, -1)
        best = jnp.argmax(score, axis=1)
        return jnp.take_along_axis(tried, best[:, None, None, None], axis=1)[:, 0]

    def _candidates(self, key, plan):
        """The last best plan, the same shifted by a piece, straight ways, and random ones that turn
        as often as not.
        """
        settings = self.settings
        number = plan.shape[0]
        straight = (settings.plans - 2) // 3
        turn_key, way_key, spin_key = jax.random.split(key, 3)
        shifted = jnp.concatenate([plan[:, 1:], plan[:, -1:]], axis=1)
        ways = _unit(jax.random.normal(spin_key, (number, straight, 1, 3)))
        ways = jnp.broadcast_to(ways, (number, straight, settings.pieces, 3))
        others = settings.plans - 2 - straight
        drawn = _unit(jax.random.normal(way_key, (number, others, settings.pieces, 3)))
        turns = jax.random.uniform(turn_key, drawn.shape[:3]) < 0.5

        def follow(before, piece):
            way, turn = piece
            now = jnp.where(turn[..., None], way, before)
            return now, now

        pieces = (jnp.moveaxis(drawn, 2, 0), jnp.moveaxis(turns, 2, 0))
        bent = jnp.moveaxis(jax.lax.scan(follow, drawn[:, :, 0], pieces)[1], 0, 2)
        return jnp.concatenate([plan[:, None], shifted[:, None], ways, bent], axis=1)

    def _promise(self, start: PursuitState, end: PursuitState) -> jax.Array:
        """() how good the end of a plan is: steps free first, then the room that is left."""
        game = self.environment.settings
        newly = end.statistics.captured & ~start.statistics.captured
        horizon = self.settings.pieces * self.settings.hold
        free = jnp.where(newly, end.statistics.capture_step - start.step, horizon)
        ahead = end.drones.position + self.settings.ahead * end.drones.velocity
        room = jnp.min(jnp.linalg.norm(ahead - end.evader_position, axis=-1))
        return free + room / game.arena_radius


def world_states(world: tuple[Observation, PursuitState]) -> PursuitState:
    """The states of worlds (B, ...)."""
    return world[1]


def _unit(vector):
    return vector / jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + np.float32(1e-12))
