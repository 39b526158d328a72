"""Parameters of any policy for tests."""

import jax
import jax.numpy as jnp
import numpy as np


def random_parameters(policy, observation):
    """Drawn ones of the policy's shapes, so that no start hides a mistake; `init` would
    have to be compiled, which takes longer than most of these tests.
    """
    kinds = jax.eval_shape(policy.init, jax.random.key(0), observation)
    draw = np.random.default_rng(1)
    return jax.tree.map(
        lambda kind: jnp.asarray(0.3 * draw.normal(size=kind.shape), kind.dtype), kinds
    )
