"""DACOOP (Zhang et al., 2022, Multi-robot cooperative pursuit via potential
field-enhanced reinforcement learning).

A network turns the two main parameters of the potential field at every step and for
each pursuer: the scale of the obstacles' repulsion and the balance of the force between
pursuers. As in the paper, MAPPO learns them in place of D3QN, so they are continuous.
The network is the actor that plain MAPPO has; its two outputs, in -1..1, are positions
between the ends of both ranges, on a logarithmic scale, and training starts from the
field of `START`.
"""

import dataclasses
import math

import jax

from openjax.baselines.apf import ApfParameters, apf
from openjax.baselines.craft_policy import CraftPolicy
from openjax.baselines.parameters import ranges
from openjax.baselines.surroundings import surroundings
from openjax.baselines.velocity_controller import velocity_action
from openjax.pursuit import Observation

LEARNED = ("repulsion", "balance")
START = ApfParameters(repulsion=2e-3, influence=0.4, margin=0.08, balance=0.5)
"""The field at the start of training; what isn't learnt stays, also of shipped weights,
whatever a search finds.
"""


@dataclasses.dataclass(frozen=True)
class DacoopPolicy(CraftPolicy):
    """A policy whose samples are parameters of the field instead of commands."""

    NAME = "dacoop"

    @staticmethod
    def start() -> tuple[float, ...]:
        """The field of `START`."""
        places = [_place(name, getattr(START, name)) for name in LEARNED]
        # at the end of a range the tanh is flat: from there nothing would be learnt
        return tuple(math.atanh(min(max(place, -0.95), 0.95)) for place in places)

    def action(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The action (..., N, 4) in -1..1 of a sample (..., N, 2) of the Gaussian,
        or of its mean.
        """
        return velocity_action(self.craft, observation, self.desired_velocity(sample, observation))

    def desired_velocity(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The velocities (..., N, 3), m/s, world, that a sample asks for."""
        parameters = field_parameters(super().action(sample, observation))
        return apf(self.craft, parameters, surroundings(self.craft, observation))


def field_parameters(output: jax.Array) -> ApfParameters:
    """The field (leaves (..., N)) that outputs (..., N, 2) in -1..1 choose."""
    outputs = {}
    for i, name in enumerate(LEARNED):
        low, high = ranges(ApfParameters)[name]
        outputs[name] = low * (high / low) ** (0.5 * (output[..., i] + 1.0))
    constants = {
        name: getattr(START, name) for name in ranges(ApfParameters) if name not in LEARNED
    }
    return ApfParameters(**constants, **outputs)


def _place(name, value):
    """A value's place in its range on the logarithmic scale, from -1 to 1."""
    low, high = ranges(ApfParameters)[name]
    return 2.0 * math.log(value / low) / math.log(high / low) - 1.0
