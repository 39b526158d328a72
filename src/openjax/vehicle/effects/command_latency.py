"""Commands arrive late."""

from openjax.vehicle.effects.delay import fill, look_back, push
from openjax.vehicle.effects.effect import NOT_NEGATIVE, Card, Effect, Fitted, Parameter
from openjax.vehicle.parameters import hover_command


def initial_memory(vehicle, state, dt, key):
    """A memory in which hover had been commanded before."""
    return fill(hover_command(vehicle, state.position.dtype), dt)


def command(parameters, memory, command, context):
    """The command of `delay` seconds ago."""
    # pushed first: with no delay it is the new one that arrives
    memory = push(memory, command)
    return look_back(memory, parameters["delay"], context.dt), memory


EFFECT = Effect(
    name="command_latency",
    description="the rate controller gets commands of a fixed time ago",
    formula=r"u'(t) = u(t - \Delta)",
    parameters={
        "delay": Parameter(
            "s",
            0.0,
            (0.004, 0.06),
            "radio links of the Crazyflie and of ROS bridges",
            domain=NOT_NEGATIVE,
        )
    },
    command=command,
    initial_memory=initial_memory,
    card=Card(
        path="radio",
        fitted=(Fitted("delay", mean=0.0, spread=0.02, start=0.01, step=0.0005, sample=0.03),),
        next_flight="steps of commanded thrust and rates, with motor commands logged.",
    ),
)
