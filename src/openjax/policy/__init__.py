"""The networks: attention encoder, actor, critic, evader predictor."""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "mixed_policy": "MixedPolicy SortedPolicy mixed_parameters",
        "outputs": "make_policy register_output",
        "own_network": "Network OwnPolicy check_network",
        "policy": "Policy PolicyParameters gaussian_entropy gaussian_log_prob",
        "settings": "NetworkSettings PredictorSettings",
    },
)
