"""The policies by what their actors put out (`NetworkSettings.output`)."""

from openjax.errors import UserError
from openjax.policy.mixed_policy import MixedPolicy
from openjax.policy.policy import Policy
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Pursuit

OUTPUTS: dict[str, type[Policy]] = {"commands": Policy}
"""The kind of policy for each name; `openjax.baselines` adds those that its controller
flies.
"""


def register_output(name: str, kind: type[Policy]) -> None:
    """From now on `make_policy` makes a policy of this kind where settings name that
    output.
    """
    OUTPUTS[name] = kind


def make_policy(
    environment: Pursuit, network: NetworkSettings, predictor: PredictorSettings
) -> Policy | MixedPolicy:
    """The policy for an environment, of the kind that `network.output` says, with a
    member for each of the team's strategies.

    Raises:
      UserError: nobody has registered that output.
    """
    if network.output not in OUTPUTS:
        raise UserError(
            f"network.output {network.output}: unknown here; known are {', '.join(OUTPUTS)}, more "
            "after import openjax.baselines"
        )
    policy = OUTPUTS[network.output].for_environment(environment, network, predictor)
    members = environment.settings.strategies
    return policy if members == 1 else MixedPolicy(policy, members)
