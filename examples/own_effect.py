"""A physical effect of one's own, flown and diagnosed: a cable hangs from the vehicle to the floor.

python examples/own_effect.py
"""

import tempfile
from pathlib import Path

import jax.numpy as jnp

from openjax import gap
from openjax.commands import sample_flights
from openjax.vehicle.effects import Card, Effect, Fitted, Parameter, register_effect
from openjax.vehicle.rigid_body import rotate_inverse


def wrench(parameters, context):
    """The weight of what hangs: force (3,) N and torque (3,) N m, in the body frame."""
    pull = -parameters["weight"] * context.position[2]
    return rotate_inverse(context.quaternion, jnp.array([0.0, 0.0, pull])), jnp.zeros(3)


tether = Effect(
    name="tether",
    description="the weight of a cable that hangs down to the floor",
    parameters={"weight": Parameter("N/m", 0.0, (0.01, 0.05), "thin cables, 1 to 5 g a metre")},
    wrench=wrench,
    card=Card(
        fitted=(Fitted("weight", mean=0.0, spread=0.03, start=0.01, step=0.0005, sample=0.03),),
        next_flight="climb slowly to the ceiling and back.",
    ),
)
register_effect(tether)  # before the diagnosis is loaded, which is when it is first asked

folder = Path(tempfile.mkdtemp()) / "tether"
sample_flights.make_case(sample_flights.SampleFlightsCommand(folder, effect=("tether",)))
report = gap.diagnose_case(gap.load_case(folder))
print("\n".join(report.in_words()))
