"""Train from Python, fly what came of it, and go on flying it in one's own loop.

python examples/train_from_python.py [MINUTES]
"""

import dataclasses
import sys

import jax

import openjax

minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 6.0
settings = openjax.preset("quick")
settings = dataclasses.replace(settings, seed=1)  # any field of any part can be replaced

policy = openjax.train(settings, "runs/from_python", minutes=minutes, overwrite=True)
record = openjax.evaluate(policy, "empty", episodes=32)
print(f"captured in {record['capture_rate']:.0%} of the episodes in the empty arena")

game = openjax.make(policy.settings.environment)
observation, state = game.reset(jax.random.key(0))
step = jax.jit(game.step)
for _ in range(20):
    observation, state, reward, terminated, truncated, info = step(
        jax.random.key(0), state, policy(observation)
    )
print(
    "distances to the evader [m]:",
    jax.numpy.linalg.norm(state.drones.position - state.evader_position, axis=-1),
)
