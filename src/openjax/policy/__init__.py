"""The networks: attention encoder, actor, critic, evader predictor."""

from openjax.policy.policy import Policy, PolicyParameters, gaussian_entropy, gaussian_log_prob
from openjax.policy.settings import NetworkSettings, PredictorSettings

__all__ = [
    "NetworkSettings",
    "Policy",
    "PolicyParameters",
    "PredictorSettings",
    "gaussian_entropy",
    "gaussian_log_prob",
]
