"""Physical effects that the nominal vehicle leaves out: twenty, one file each, to fly
with and to fit.

In a step: `make_drones_step(effects=("rotor_drag",))`, with `{"rotor_drag": {"d_xy":
0.01}}` as its parameters. On logged states, without simulating: the hooks of
`EFFECTS[name]` are pure functions of one sample, to be mapped and differentiated. The
force of rotor drag along a flight (states: leading axis T):

    drag = EFFECTS["rotor_drag"]
    context = jax.vmap(lambda state: make_context(vehicle, state))(states)
    force, torque = jax.vmap(lambda c: drag.wrench({"d_xy": d, "d_z": 0.0}, c))(context)
"""

from openjax.vehicle.effects.composition import (
    complete_parameters,
    initial_memory,
    resolve,
    seen_state,
)
from openjax.vehicle.effects.effect import (
    Card,
    Context,
    Effect,
    Fitted,
    Nuisance,
    Parameter,
    make_context,
)
from openjax.vehicle.effects.effects_file import load_effects, save_effects
from openjax.vehicle.effects.registry import EFFECTS, register_effect

__all__ = [
    "EFFECTS",
    "Card",
    "Context",
    "Effect",
    "Fitted",
    "Nuisance",
    "Parameter",
    "complete_parameters",
    "initial_memory",
    "load_effects",
    "make_context",
    "register_effect",
    "resolve",
    "save_effects",
    "seen_state",
]
