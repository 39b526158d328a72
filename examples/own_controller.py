"""One's own controller on a test layout: running after the evader catches a slower one, and only a
team that plans catches a faster one.

python examples/own_controller.py
"""

import jax.numpy as jnp

import openjax
from openjax.pursuit import hover_action

HOVER = hover_action(openjax.make().vehicle)[0]


def chase(observation):
    """Lean towards where the evader was last seen and a little away from the others, with what a
    real pursuer knows.
    """
    tilt = observation.self_state[:, 4:6]  # sine of half the roll and pitch
    velocity = observation.self_state[:, 7:10]
    others = observation.others  # (N, N - 1, 3) m, from another pursuer to the own position
    apart = jnp.sum(others / jnp.sum(others**2, axis=-1, keepdims=True), axis=1)
    height = jnp.clip(observation.last_seen[2], 0.2, 0.9)  # it dives; floor and ceiling are solid
    towards = observation.last_seen.at[2].set(height) - observation.position
    towards = towards + 0.03 * apart * jnp.array([1.0, 1.0, 0.3])
    lean = jnp.array([-1.0, 1.0])  # roll moves towards -y, pitch towards +x
    wanted = jnp.clip(lean * (0.5 * towards[:, [1, 0]] - 0.15 * velocity[:, [1, 0]]), -0.2, 0.2)
    thrust = HOVER + 1.0 * towards[:, 2] - 0.5 * velocity[:, 2]
    return jnp.column_stack([thrust, 4.0 * (wanted - tilt), jnp.zeros(len(thrust))])


for name, policy, speed in (("slower", chase, 0.8), ("faster", chase, 1.3), ("open", "open", 1.3)):
    game = {"start_attitude": "level", "evader_speed": speed}
    record = openjax.evaluate(policy, "empty", episodes=16, **game)
    print(f"{name:6} captured {record['capture_rate']:.2f}, crashed {record['crash_rate']:.2f}")
