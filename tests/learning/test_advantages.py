"""Advantages against a plain Python reference, with terminated and truncated
episodes.
"""

import jax
import numpy as np
import pytest

from openjax.learning.advantages import generalised_advantages


def reference(reward, value, next_value, terminated, truncated, discount, trace):
    """Sum of discounted errors of value up to the end of each step's own episode."""
    advantage = np.zeros_like(reward)
    for start in range(len(reward)):
        weight = 1.0
        for t in range(start, len(reward)):
            following = 0.0 if terminated[t] else next_value[t]
            advantage[start] += weight * (reward[t] + discount * following - value[t])
            if terminated[t] or truncated[t]:
                break
            weight *= discount * trace
    return advantage


@pytest.mark.parametrize("trace", [0.95, 0.0, 1.0])
def test_against_plain_python(trace):
    draw = np.random.default_rng(0)
    reward, value, next_value = draw.normal(size=(3, 12, 20))
    ends = draw.uniform(size=(12, 20))
    terminated = ends < 0.1
    truncated = (ends > 0.1) & (ends < 0.2)
    truncated[:, 0], terminated[:, 0] = False, False  # one world without an end
    terminated[-1, 1] = True
    expected = [
        reference(
            *(x[:, e] for x in (reward, value, next_value, terminated, truncated)), 0.9, trace
        )
        for e in range(20)
    ]
    got = jax.jit(generalised_advantages, static_argnums=(5, 6))(
        *(x.astype(np.float32) for x in (reward, value, next_value)),
        terminated,
        truncated,
        0.9,
        trace,
    )
    np.testing.assert_allclose(got, np.stack(expected, axis=1), atol=1e-5)
