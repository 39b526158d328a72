"""One's own controller on the test layouts, beside a shipped policy: capture rate, collisions,
crashes.

python examples/own_controller.py
"""

import jax.numpy as jnp

import openjax
from openjax.pursuit import hover_action

HOVER = hover_action(openjax.make().vehicle)[0]


def chase(observation):
    """Lean towards where the evader was last seen and away from the others, with what a real
    pursuer knows.
    """
    quaternion = observation.self_state[:, 3:7]
    velocity = observation.self_state[:, 7:10]
    others = observation.others  # (N, N - 1, 3) m, from another pursuer to the own position
    apart = jnp.sum(others / jnp.sum(others**2, axis=-1, keepdims=True), axis=1)
    target = observation.last_seen.at[2].set(
        0.5
    )  # at one height: the evader may dive, the floor is solid
    towards = target - observation.position + 0.15 * apart
    lean = jnp.array([-1.0, 1.0])  # roll moves towards -y, pitch towards +x
    wanted = lean * (0.2 * towards[:, [1, 0]] - 0.1 * velocity[:, [1, 0]])
    rates = 4.0 * (wanted - quaternion[:, 1:3])
    thrust = HOVER + 0.5 * towards[:, 2] - 0.4 * velocity[:, 2]
    return jnp.column_stack([thrust, rates, jnp.zeros(len(thrust))])


for name, policy in (("chase", chase), ("apf", "apf"), ("open", "open")):
    record = openjax.evaluate(policy, "empty", episodes=16, start_attitude="level")
    print(f"{name:6} captured {record['capture_rate']:.2f}, crashed {record['crash_rate']:.2f}")
