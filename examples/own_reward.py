"""A reward term of one's own: pursuers are paid for standing on all sides of the evader.

python examples/own_reward.py [MINUTES]
"""

import sys

import jax.numpy as jnp

import openjax
from openjax.pursuit import Term, default_reward


def surround(step):
    """() from 0, where all pursuers are on one side of the evader, to 1, where they are all
    around.
    """
    towards = step.state.drones.position - step.state.evader_position
    direction = towards / jnp.linalg.norm(towards + 1e-6, axis=-1, keepdims=True)
    return 1.0 - jnp.linalg.norm(jnp.mean(direction, axis=0) + 1e-6)


minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 6.0
settings = openjax.preset("quick")
shipped = default_reward(settings.environment.reward)
game = openjax.Pursuit(settings.environment, reward=(*shipped, Term(surround, 0.5)))
policy = openjax.train(
    settings, "runs/own_reward", environment=game, minutes=minutes, overwrite=True
)
record = openjax.evaluate(policy, "empty", episodes=16)
print(f"captured in {record['capture_rate']:.0%} of the episodes in the empty arena")
