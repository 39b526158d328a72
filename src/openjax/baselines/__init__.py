"""Methods without a learned policy of their own: those that the paper compares with
(Angelani, Janosov, potential field, DACOOP; see docs/methods.md), and stack, which
forces a capture.
"""

from openjax.baselines.craft_policy import CraftPolicy
from openjax.baselines.dacoop import DacoopPolicy
from openjax.baselines.heuristic import METHODS, Heuristic
from openjax.baselines.velocity_controller import velocity_action
from openjax.baselines.velocity_policy import VelocityPolicy
from openjax.policy import register_output

__all__ = [
    "METHODS",
    "CraftPolicy",
    "DacoopPolicy",
    "Heuristic",
    "VelocityPolicy",
    "velocity_action",
]

register_output("velocity", VelocityPolicy)
register_output("field", DacoopPolicy)
