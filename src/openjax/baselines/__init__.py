"""Methods without a learned policy of their own: those that the paper compares with (Angelani,
Janosov, potential field, DACOOP; see docs/methods.md), and stack, which forces a capture.
"""

from openjax.baselines.craft_policy import CraftPolicy
from openjax.baselines.dacoop import DacoopPolicy
from openjax.baselines.heuristic import METHODS, Heuristic
from openjax.baselines.velocity_controller import velocity_action
from openjax.baselines.velocity_policy import VelocityPolicy
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit

__all__ = [
    "METHODS",
    "CraftPolicy",
    "DacoopPolicy",
    "Heuristic",
    "VelocityPolicy",
    "make_policy",
    "velocity_action",
]


def make_policy(
    environment: Pursuit, network: NetworkSettings, predictor: PredictorSettings
) -> Policy:
    """The policy for an environment, of the kind that `network.output` says."""
    kinds = {"commands": Policy, "velocity": VelocityPolicy, "field": DacoopPolicy}
    return kinds[network.output].for_environment(environment, network, predictor)
