"""The evader prediction network: an LSTM over the last frames (the paper's section
IV-B1).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from openjax.policy.settings import PredictorSettings


class EvaderPredictor(nn.Module):
    """Future evader positions from a window of frames; see
    `openjax.pursuit.observation.frame`.
    """

    settings: PredictorSettings
    arena_radius: float
    arena_height: float

    @nn.compact
    def __call__(
        self, frames: Float[Array, "*worlds window features"], last_seen: Float[Array, "*worlds 3"]
    ) -> Float[Array, "*worlds horizons 3"]:
        """Positions (m, world) from frames, oldest first, and where the evader was last
        seen (m).
        """
        units = self.settings.units
        horizons = self.settings.horizons
        # all frames' projections in one product; only the recurrent part is sequential
        inputs = nn.Dense(4 * units, name="input")(frames)
        recurrent = self.param("recurrent", nn.initializers.orthogonal(), (units, 4 * units))
        state = cell = jnp.zeros((*frames.shape[:-2], units), jnp.float32)
        for i in range(frames.shape[-2]):
            gates = inputs[..., i, :] + state @ recurrent
            in_gate, forget_gate, candidate, out_gate = jnp.split(gates, 4, axis=-1)
            # one more, so that a fresh cell forgets little (Jozefowicz et al. 2015, An
            # empirical exploration of recurrent network architectures)
            forget = jax.nn.sigmoid(forget_gate + 1.0) * cell
            cell = forget + jax.nn.sigmoid(in_gate) * jnp.tanh(candidate)
            state = jax.nn.sigmoid(out_gate) * jnp.tanh(cell)
        # small, so that a fresh predictor says where the evader was last seen
        initial = nn.initializers.orthogonal(0.1)
        output = nn.Dense(3 * len(horizons), kernel_init=initial, name="output")(state)
        output = output.reshape(*output.shape[:-1], len(horizons), 3)
        scale = jnp.array(
            [self.arena_radius, self.arena_radius, self.arena_height / 2], jnp.float32
        )
        # within a horizon the evader moves a tenth of the arena or so: outputs of one order
        return last_seen[..., None, :] + 0.1 * scale * output
