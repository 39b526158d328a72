"""A policy for a game in which it observes more of its own history: the same policy
until it learns to use it.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from openjax.errors import UserError
from openjax.policy.policy import PolicyParameters
from openjax.policy.settings import PredictorSettings
from openjax.pursuit.settings import OWN_FRAME, PursuitSettings


def with_longer_history(
    parameters: PolicyParameters,
    predictor: PredictorSettings,
    old: PursuitSettings,
    new: PursuitSettings,
) -> PolicyParameters:
    """`parameters` of a policy trained in the game `old`, for the game `new`, which
    observes as long a history or longer.

    The first layer's weights for the additional, older frames are zero. The critic,
    which may see other privileged numbers as well, is left out where the history grows.

    Raises:
      UserError: the policy isn't made of networks.
    """
    more = (new.observe_history - old.observe_history) * OWN_FRAME
    if more <= 0:
        return parameters
    if not (isinstance(parameters.actor, Mapping) and "params" in parameters.actor):
        raise UserError("the policy has no networks that could learn")
    # the history comes last in the own state, its oldest frame first: the new rows
    # stand before it
    place = old.self_size - old.observe_history * OWN_FRAME
    inputs = old.self_size + (3 * len(predictor.horizons) if predictor.enabled else 0)

    def grow(actor: Any) -> Any:
        params = dict(actor["params"])
        encoder = dict(params["encoder"])
        # without the rows for the encoder's padding, which are added anew for the new
        # length
        kernel = encoder["self_1"]["kernel"][:inputs]
        zeros = jnp.zeros((more, kernel.shape[1]), kernel.dtype)
        kernel = jnp.concatenate([kernel[:place], zeros, kernel[place:]])
        # to a multiple of eight, as the encoder pads what it observes
        kernel = jnp.pad(kernel, ((0, -kernel.shape[0] % 8), (0, 0)))
        encoder["self_1"] = {**encoder["self_1"], "kernel": kernel}
        return {**actor, "params": {**params, "encoder": encoder}}

    return parameters.replace(actor=grow(parameters.actor), critic={})
