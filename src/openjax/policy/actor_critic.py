"""Actor and critic (the paper's section IV-B)."""

import math

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from openjax.policy.encoder import Encoder, HiddenLayer, pad
from openjax.policy.settings import NetworkSettings
from openjax.pursuit import Observation
from openjax.pursuit.axes import turned_back


class Actor(nn.Module):
    """Mean and log standard deviation of the Gaussian over actions."""

    settings: NetworkSettings
    initial_action: tuple[float, ...]
    """Mean before the tanh at initialisation: hovering."""

    @nn.compact
    def __call__(
        self, observation: Observation, prediction: Float[Array, "*worlds horizons 3"] | None
    ) -> tuple[
        Float[Array, "*worlds pursuers sample"],
        Float[Array, " sample"],
        Float[Array, "*worlds pursuers features"],
    ]:
        """Mean, log standard deviation, and what the encoder made of the observation;
        predicted positions in m.
        """
        settings = self.settings
        features = Encoder(
            settings.features, settings.heads, jnp.dtype(settings.compute_type), name="encoder"
        )(
            own_features(observation, prediction),
            observation.others,
            observation.pillars,
            observation.pillar_seen,
            observation.others_there,
        )
        start = jnp.array(self.initial_action, jnp.float32)
        mean = nn.Dense(
            len(self.initial_action),
            dtype=jnp.float32,
            # so small that a fresh policy hovers whatever it sees
            kernel_init=nn.initializers.orthogonal(0.01),
            bias_init=lambda key, shape, dtype: start.astype(dtype),
            name="mean",
        )(features)
        log_std = self.param(
            "log_std",
            nn.initializers.constant(settings.initial_log_std),
            (len(self.initial_action),),
        )
        if settings.squash == "mean":
            mean = jnp.tanh(mean)
        return mean, log_std, features


class Critic(nn.Module):
    """Normalised value of each pursuer's state."""

    settings: NetworkSettings

    @nn.compact
    def __call__(
        self,
        observation: Observation,
        prediction: Float[Array, "*worlds horizons 3"] | None,
        encoding: Float[Array, "*worlds pursuers features"] | None = None,
    ) -> Float[Array, "*worlds pursuers"]:
        """Values; `encoding` is what the actor's encoder made of the observation, if
        the encoder is shared.
        """
        settings = self.settings
        dtype = jnp.dtype(settings.compute_type)
        if settings.shared_encoder:
            features = pad(
                jnp.concatenate([encoding, observation.privileged.astype(dtype)], axis=-1)
            )
        else:
            itself = own_features(observation, prediction)
            itself = jnp.concatenate([itself, observation.privileged], axis=-1)
            features = self._encode(itself, observation, dtype)
        # one matrix product over all worlds and pursuers
        leading = features.shape[:-1]
        features = HiddenLayer(settings.features, dtype, name="hidden")(
            features.reshape(math.prod(leading), features.shape[-1])
        )
        value = nn.Dense(
            1, dtype=jnp.float32, kernel_init=nn.initializers.orthogonal(1.0), name="value"
        )(features)
        return value.reshape(leading)

    def _encode(self, itself, observation, dtype):
        """The embedding that the critic's own encoder makes of a pursuer's own part
        and the rest.
        """
        settings = self.settings
        leading = itself.shape[:-1]
        if settings.critic_encoder == "attention":
            return Encoder(settings.features, settings.heads, dtype, name="encoder")(
                itself,
                observation.others,
                observation.pillars,
                observation.pillar_seen,
                observation.others_there,
            )
        number = math.prod(leading)
        parts = [
            x.reshape(number, math.prod(x.shape[len(leading) :]))
            for x in (itself, observation.others, observation.pillars)
        ]
        features = pad(jnp.concatenate(parts, axis=-1))
        for name in ("layer_1", "layer_2"):
            features = HiddenLayer(2 * settings.features, dtype, name=name)(features)
        return features.reshape(*leading, features.shape[-1])


def own_features(
    observation: Observation, prediction: Float[Array, "*worlds horizons 3"] | None
) -> Float[Array, "*worlds pursuers own"]:
    """A pursuer's own part: its state and, relative to it, the predicted evader
    positions (m).
    """
    if prediction is None:
        return observation.self_state
    relative = observation.position[..., :, None, :] - prediction[..., None, :, :]
    relative = turned_back(observation.heading, relative)
    return jnp.concatenate(
        [observation.self_state, relative.reshape(*relative.shape[:-2], -1)], axis=-1
    )
