"""An observation of one's own: each pursuer also knows how fast it comes nearer to the evader.

python examples/own_observation.py [MINUTES]
"""

import sys

import jax.numpy as jnp

import openjax
from openjax.pursuit import observe


def with_closing_speed(settings, state, seen_drones):
    """The game's own observation with one number more for each pursuer, zero where it can't be
    known.
    """
    shipped = observe(settings, state, seen_drones)
    towards = state.evader_position - seen_drones.position
    relative = seen_drones.velocity - state.evader_velocity
    distance = jnp.linalg.norm(towards + 1e-6, axis=-1, keepdims=True)
    closing = jnp.sum(towards * relative, axis=-1, keepdims=True) / distance
    known = jnp.where(state.seen, closing, 0.0)
    return shipped.replace(self_state=jnp.concatenate([shipped.self_state, known], axis=-1))


minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 6.0
settings = openjax.preset("quick")
game = openjax.Pursuit(settings.environment, observer=with_closing_speed)
policy = openjax.train(
    settings, "runs/own_observation", environment=game, minutes=minutes, overwrite=True
)
record = openjax.evaluate(policy, "empty", episodes=16)
print(f"captured in {record['capture_rate']:.0%} of the episodes in the empty arena")
