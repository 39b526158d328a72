"""Learnt policies whose samples aren't commands: a velocity controller flies what they
stand for.
"""

import dataclasses
from typing import ClassVar

from openjax.baselines.surroundings import Craft
from openjax.baselines.velocity_controller import check_flyable
from openjax.policy import NetworkSettings, Policy, PredictorSettings
from openjax.pursuit import Pursuit


@dataclasses.dataclass(frozen=True)
class CraftPolicy(Policy):
    """A policy that ends in the velocity controller of a `craft`."""

    craft: Craft = dataclasses.field(default_factory=Craft)

    NAME: ClassVar[str]
    """Its name in errors."""

    @staticmethod
    def start() -> tuple[float, ...]:
        """The mean of the Gaussian before training, before the tanh."""
        raise NotImplementedError

    @classmethod
    def for_environment(
        cls, environment: Pursuit, network: NetworkSettings, predictor: PredictorSettings
    ) -> "CraftPolicy":
        """The policy for an environment; its mean starts at `start`.

        Raises:
          UserError: the velocity controller can't fly there.
        """
        craft = Craft.of(environment)
        check_flyable(cls.NAME, craft, environment.settings.time_step)
        plain = super().for_environment(environment, network, predictor)
        return dataclasses.replace(plain, initial_action=cls.start(), craft=craft)
