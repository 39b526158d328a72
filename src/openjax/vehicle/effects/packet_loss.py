"""Some commands never arrive: the last one is held.

Which are lost is drawn from a key in the memory. In a replay that knows,
`Context.packet_lost` decides instead (1 lost, 0 arrived). A share between gives the
mean over draws of one step, which is differentiable in that share.
"""

import jax
import jax.numpy as jnp

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Parameter
from openjax.vehicle.parameters import hover_command


def initial_memory(vehicle, state, dt, key):
    return {"held": hover_command(vehicle, state.position.dtype), "key": jax.random.key_data(key)}


def command(parameters, memory, command, context):
    """The command, or the one that is held where this one is lost."""
    # drawn in any case: whether a replay knows is told by a value, at run time
    draw, carry = jax.random.split(jax.random.wrap_key_data(memory["key"]))
    is_drawn = jax.random.uniform(draw, (), command.dtype) < parameters["probability"]
    is_logged = ~jnp.isnan(context.packet_lost)
    is_lost = jnp.where(is_logged, context.packet_lost, is_drawn.astype(command.dtype))
    # a sum of shares, so that a replay's `lost` may lie between and has a slope
    command = (1.0 - is_lost) * command + is_lost * memory["held"]
    return command, {"held": command, "key": jax.random.key_data(carry)}


EFFECT = Effect(
    name="packet_loss",
    description="each command is lost with a fixed probability, and the last one is held",
    formula=r"u'_k = u_k \text{ with probability } 1 - p,\ \text{else } u'_{k-1}",
    parameters={
        "probability": Parameter(
            "1",
            0.0,
            (0.01, 0.5),
            "2.4 GHz radio in crowded rooms and swarms: 1-50 %",
            domain=(0.0, 1.0),
        )
    },
    command=command,
    initial_memory=initial_memory,
    random=True,
    card=Card(
        path="radio",
        fitted=(Fitted("probability", mean=0.0, spread=0.15, start=0.05, step=0.01, sample=0.2),),
        next_flight="steps of commanded thrust and rates, with motor commands logged.",
    ),
)
