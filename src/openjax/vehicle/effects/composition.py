"""Several effects at once. They act in the order of their names, whatever order they
are given in.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from openjax.errors import UserError, part_name
from openjax.vehicle.effects.effect import Context, Effect
from openjax.vehicle.effects.registry import find_effect
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rotors import rotor_reaction, rotor_thrust, total_wrench
from openjax.vehicle.state import DroneState

AIR_TIME = "air_time"  # beside the effects' own memories


def resolve(effects) -> tuple[Effect, ...]:
    """Effects from names or `Effect`s, in the order in which they act. Raises UserError
    for unknown names.
    """
    by_name = {}
    for effect in effects:
        effect = effect if isinstance(effect, Effect) else find_effect(effect)
        by_name[effect.name] = effect
    return tuple(by_name[name] for name in sorted(by_name))


def complete_parameters(
    effects, partial: Mapping[str, Mapping[str, Any]] | None, dtype
) -> dict[str, dict]:
    """Parameters of every effect as arrays; what `given` leaves out has no effect.

    Raises UserError for effects or parameters that aren't known.
    """
    partial = partial or {}
    by_name = {effect.name: effect for effect in effects}
    for name, values in partial.items():
        if name not in by_name:
            raise UserError(
                f"parameters for {name!r}, which is not among the effects {sorted(by_name)}"
            )
        for parameter in values:
            find_effect(name, parameter, effects=by_name)
    complete = {
        name: {**effect.none(), **partial.get(name, {})} for name, effect in by_name.items()
    }
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), complete)


def initial_memory(effects, vehicle: Vehicle, state: DroneState, dt: float, key=None):
    """Memory of the effects for one drone at the start of an episode; () without
    effects.

    Raises UserError if an effect draws random numbers and `key` is None.
    """
    if not effects:
        return ()
    memory = {AIR_TIME: jnp.zeros((), state.position.dtype)}
    for number, effect in enumerate(effects):
        if effect.random and key is None:
            raise UserError(f"effect {effect.name!r} is random: its memory needs a key")
        if effect.initial_memory is not None:
            # a key of its own for each: two random effects mustn't draw the same
            # numbers
            effect_key = None if key is None else jax.random.fold_in(key, number)
            memory[effect.name] = effect.initial_memory(vehicle, state, dt, effect_key)
    return memory


def change_body(effects, parameters, vehicle: Vehicle) -> Vehicle:
    """The vehicle that really flies."""
    for effect in effects:
        if effect.body is not None:
            vehicle = effect.body(parameters[effect.name], vehicle)
    return vehicle


def change_command(effects, parameters, memory, command, context: Context):
    """The command (4,) that reaches the rate controller, and the memory after it."""
    for effect in effects:
        if effect.command is not None:
            result = effect.command(parameters[effect.name], memory[effect.name], command, context)
            _check_pair(effect, "command", result)
            _check_shapes(effect, "command", result[0], command)
            command, memory_of_effect = result
            memory = {**memory, effect.name: memory_of_effect}
    return command, memory


def change_motor_command(effects, parameters, motor_command, context: Context):
    """The motor command (4,) that the motors follow; negative thrust is beyond a
    rotor.
    """
    command = motor_command
    for effect in effects:
        if effect.motor is not None:
            command = effect.motor(parameters[effect.name], command, context)
            _check_shapes(effect, "motor", command, motor_command)
    # what no effect changed is in 0..1 already, and is left as it is, bit for bit
    return command if command is motor_command else jnp.maximum(command, 0.0)


def change_thrust(effects, parameters, thrust, reaction, context: Context):
    """Thrust (4,) N and reaction torque (4,) N m of the rotors."""
    for effect in effects:
        if effect.thrust is not None:
            result = effect.thrust(parameters[effect.name], thrust, reaction, context)
            _check_shapes(effect, "thrust", result, (thrust, reaction))
            thrust, reaction = result
    return thrust, reaction


def added_wrench(effects, parameters, context: Context):
    """Force (3,) N and torque (3,) N m of the effects on the body, body frame."""
    force = torque = jnp.zeros_like(context.velocity)
    for effect in effects:
        if effect.wrench is not None:
            result = effect.wrench(parameters[effect.name], context)
            _check_shapes(effect, "wrench", result, (force, torque))
            more_force, more_torque = result
            force = force + more_force
            torque = torque + more_torque
    return force, torque


def wrench(effects, parameters, vehicle: Vehicle, rotor_speed, context: Context | None):
    """Force (3,) N and torque (3,) N m about the centre of mass on the body, body
    frame, of rotors and effects.

    rotor_speed (4,) rad/s; without effects there need be no `context`.
    """
    thrust = rotor_thrust(vehicle, rotor_speed)
    reaction = rotor_reaction(vehicle, rotor_speed)
    if not effects:
        return total_wrench(vehicle, thrust, reaction)
    context = context.replace(rotor_speed=rotor_speed, thrust=thrust)
    thrust, reaction = change_thrust(effects, parameters, thrust, reaction, context)
    force, torque = total_wrench(vehicle, thrust, reaction)
    # drag and flapping grow with the thrust that the rotors really give, ground effect
    # included
    more_force, more_torque = added_wrench(effects, parameters, context.replace(thrust=thrust))
    return force + more_force, torque + more_torque


def check_memory(effects, memory) -> None:
    """Raises UserError where the drones have no memory of the effects."""
    if effects and not isinstance(memory, dict):
        raise UserError(
            "drones without memory of the effects: pass them through the step's reset() first"
        )


def air_time(effects, memory):
    """() s since the start of the episode; NaN, "not known", without effects."""
    return memory[AIR_TIME] if effects else jnp.nan


def record(effects, memory, state: DroneState, dt):
    """Memory at the end of a step of dt seconds that led to `state`; without effects it
    stays.
    """
    if not effects:
        return memory
    # a new dictionary: a state that is written to would change for whoever still holds
    # it
    memory = {**memory, AIR_TIME: memory[AIR_TIME] + jnp.asarray(dt, memory[AIR_TIME].dtype)}
    for effect in effects:
        if effect.record is not None:
            memory[effect.name] = effect.record(memory[effect.name], state)
    return memory


def seen_state(effects, parameters, state: DroneState) -> DroneState:
    """The off-board controller's view of one drone in `state`."""
    for effect in effects:
        if effect.sensor is not None:
            result = effect.sensor(parameters[effect.name], state.effect_memory[effect.name], state)
            _check_shapes(effect, "sensor", result, state)
            state = result
    return state


def _check_pair(effect, hook, result):
    if not isinstance(result, tuple) or len(result) != 2:
        raise UserError(
            f"effect {effect.name!r}: {hook} gives {part_name(result)}; command, memory "
            "would be right"
        )


def _check_shapes(effect, hook, result, right):
    """Raises UserError where a hook gives other arrays than it should: what somebody
    hands in is traced far from where it was written.
    """
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(result)]
    right_shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(right)]
    if shapes != right_shapes:
        raise UserError(
            f"effect {effect.name!r}: {hook} gives arrays of shapes {shapes}; "
            f"{right_shapes} would be right"
        )
