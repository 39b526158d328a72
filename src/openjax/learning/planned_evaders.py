"""Evaders that plan against the pursuers' policy as it is now, in some worlds of a rollout.

Every .2 s such an evader tries a few ways in copies of its world, in which the policy answers, and
flies the beginning of the one on which it stays free for longest. It needs no learning, so it is as
strong against the policy of this minute as against that of the last one: what evaders that learn
find after a hundred million steps, pursuers meet from the start.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from openjax.learning.settings import EvaderLearningSettings
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState

World = tuple[Observation, PursuitState]

COMMAND = 4
"""Control steps for which pursuers hold a command in the copies: the policy costs most there."""
AHEAD = 0.15
"""Seconds after which pursuers are thought to be where they fly, at a way's end: about the time in
which a vehicle turns its velocity round.
"""


@dataclass(frozen=True, eq=False)
class PlannedEvaders:
    """How the evaders of the first worlds plan, as pure functions."""

    how: EvaderLearningSettings
    environment: Pursuit
    policy: Policy

    def wishes(self, parameters: PolicyParameters, world: World, keys: jax.Array) -> jax.Array:
        """(E, 3) desired velocities in worlds (E, ...), as shares of the evader's speed, of those
        that plan; NaN for the others.

        Evaders of the settings' first kind, with which a run begins, don't plan.

        Args:
          parameters: of the policy.
          world: observation and state (E, ...).
          keys: (E,) draw what is tried.
        """
        number = keys.shape[0]
        planning = round(self.how.planned * number)
        some = jax.tree.map(lambda leaf: leaf[:planning], world)
        best = self._best(parameters, some, keys[:planning])
        best = jnp.where((some[1].evader.kind > 0)[:, None], best, jnp.nan)
        others = jnp.full((number - planning, 3), jnp.nan)
        return jax.lax.optimization_barrier(jnp.concatenate([best, others]))

    def _best(self, parameters, world, keys):
        """(W, 3) the beginning of the best way of each world (W, ...)."""
        plans, piece = self.how.plans, self.how.plan_every
        first, then = jax.vmap(self._tried)(keys)  # (W, M, 3) each
        copied = jax.tree.map(lambda leaf: jnp.repeat(leaf, plans, axis=0), world)
        free = jnp.ones(copied[1].step.shape, bool), jnp.zeros(copied[1].step.shape)
        after = self._fly(parameters, (copied, free), first.reshape(-1, 3), piece)
        (_, end), (_, steps) = self._fly(parameters, after, then.reshape(-1, 3), 2 * piece)
        ahead = end.drones.position + AHEAD * end.drones.velocity
        room = jnp.min(jnp.linalg.norm(ahead - end.evader_position[:, None], axis=-1), axis=-1)
        score = steps + room / self.environment.settings.arena_radius
        best = jnp.argmax(score.reshape(-1, plans), axis=1)
        return jnp.take_along_axis(first, best[:, None, None], axis=1)[:, 0]

    def _tried(self, key):
        """(M, 3) directions of the first piece and of what follows: half go straight on."""
        plans = self.how.plans
        directions = jax.random.normal(key, (2, plans, 3))
        first, then = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
        straight = (jnp.arange(plans) < plans // 2)[:, None]
        return first, jnp.where(straight, first, then)

    def _fly(self, parameters, carry, velocity, steps):
        """Worlds after control steps, and whether (B,) and for how many steps (B,) their evaders
        were free until then; whoever is caught once isn't free any more.
        """
        settings = self.environment.settings
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0, 0))

        def one(carry, action):
            (_, state), (free, steps) = carry
            observation, state, *_ = step(jax.random.key(0), state, action, velocity)
            away = state.drones.position - state.evader_position[:, None]
            nearest = jnp.min(jnp.linalg.norm(away, axis=-1), axis=-1)
            free = free & (nearest > settings.capture_radius)
            return ((observation, state), (free, steps + free)), None

        def command(carry, _):
            action = self.policy.act(parameters, carry[0][0])
            held = jnp.broadcast_to(action, (COMMAND, *action.shape))
            return jax.lax.scan(one, carry, held)[0], None

        return jax.lax.scan(command, carry, length=steps // COMMAND)[0]
