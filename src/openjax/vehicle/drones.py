"""The step of N drones in one world: controller, motors, effects, body."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from openjax.errors import UserError
from openjax.vehicle.arena import Arena
from openjax.vehicle.effects import composition
from openjax.vehicle.effects.effect import Context, Effect, make_context
from openjax.vehicle.mjx_body import make_world, mjx_step
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rigid_body import rigid_step, rotate
from openjax.vehicle.rigid_kernel import FusedStep, step_many
from openjax.vehicle.rotors import rotor_reaction, rotor_speed_step, rotor_thrust
from openjax.vehicle.solids import (
    Surroundings,
    contact_acceleration,
    encounters,
    others,
    place_solids,
    surroundings,
)
from openjax.vehicle.state import DroneState
from openjax.vehicle.stops import stop
from openjax.vehicle.wrench import total_wrench

PHYSICS = ("mjx", "rigid", "stops")


@dataclass(frozen=True)
class DronesStep:
    """The step of N drones of one world, made by `make_drones_step`. Its methods are pure, to be mapped."""

    physics: str
    dt: float
    substeps: int
    contacts: bool
    arena: Arena
    effects: tuple[Effect, ...] = field(repr=False)

    def __call__(
        self,
        vehicle: Vehicle,
        drones: DroneState,
        command,
        pillar_position,
        pillar_active,
        effect_parameters=None,
    ) -> DroneState:
        """`drones` (leading axis N) after one step of `dt` seconds.

        command (N, 4) as for `rate_controller`, pillar_position (P, 2) m, pillar_active (P,) bool,
        effect_parameters {effect: {parameter: () or (N,) array}} for the effects of this step, of all drones or of
        each; what is left out has no effect. The arithmetic is done in the precision of the drones' state.
        """
        dtype = drones.position.dtype
        vehicle = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), vehicle)
        command = jnp.asarray(command, dtype)
        if self.physics == "rigid" and not self.effects and dtype == jnp.float32:
            memory = drones.effect_memory  # of other effects than this step's, if any
            pillars = (pillar_position, pillar_active) if self.contacts else None
            drones = step_many(self.fused, vehicle, drones.replace(effect_memory=()), command, pillars)
            return drones.replace(effect_memory=memory)
        parameters = self._parameters(effect_parameters, drones)
        vehicle = self._body(vehicle, parameters)
        if self.effects:
            if not isinstance(drones.effect_memory, dict):
                raise UserError(
                    "drones without memory of the effects: pass them through the step's reset() first"
                )
            command, drones = self._receive(vehicle, parameters, drones, command)

        def substep(drones, _):
            return self._substep(vehicle, parameters, drones, command, pillar_position, pillar_active), None

        if self.substeps == 1:
            drones, _ = substep(drones, None)
        else:
            drones, _ = jax.lax.scan(substep, drones, None, length=self.substeps)
        if self.physics == "stops":
            drones = stop(self.arena, drones, pillar_position, pillar_active)
        if self.effects:
            memory = jax.vmap(
                lambda drone: composition.record(self.effects, drone.effect_memory, drone, self.dt)
            )(drones)
            drones = drones.replace(effect_memory=memory)
        return drones

    @property
    def fused(self) -> FusedStep:
        """`rigid` without effects, for `step_many`."""
        return FusedStep(self._plain_substep, self.substeps)

    def reset(self, vehicle: Vehicle, drones: DroneState, key=None) -> DroneState:
        """`drones` (leading axis N) with the effects' memory as at the start of an episode.

        `key` is needed by random effects only (UserError without it).
        """
        number = jnp.arange(drones.position.shape[0])

        def memory(drone, n):
            own = None if key is None else jax.random.fold_in(key, n)
            return composition.initial_memory(self.effects, vehicle, drone, self.dt, own)

        return drones.replace(effect_memory=jax.vmap(memory)(drones, number))

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """What the off-board controller sees of `drones` (leading axis N): they themselves without sensor
        effects.
        """
        if not self.effects:
            return drones
        parameters = self._parameters(effect_parameters, drones)
        axis = _drones_axis(parameters)
        return jax.vmap(functools.partial(composition.seen_state, self.effects), (axis, 0))(
            parameters, drones
        )

    def _parameters(self, given, drones):
        """Parameters of every effect, all () where all drones share them, else all (N,)."""
        parameters = composition.complete_parameters(self.effects, given, drones.position.dtype)
        if all(leaf.ndim == 0 for leaf in jax.tree.leaves(parameters)):
            return parameters
        number = drones.position.shape[0]
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (number,)), parameters)

    def _body(self, vehicle, parameters):
        """The vehicle that really flies; with parameters of each drone, every leaf has their axis first."""
        change = functools.partial(composition.change_body, self.effects)
        each = _drones_axis(parameters) is not None
        return jax.vmap(change, (0, None))(parameters, vehicle) if each else change(parameters, vehicle)

    def _contexts(self, vehicle, drones, dt) -> Context:
        neighbours = drones.position[others(drones.position.shape[0])]

        def context(vehicle, drone, neighbour):
            return make_context(
                vehicle,
                drone,
                others_position=neighbour,
                air_time=drone.effect_memory[composition.AIR_TIME],
                ceiling_height=self.arena.height,
                dt=dt,
            )

        return jax.vmap(context, (_vehicles_axis(vehicle), 0, 0))(vehicle, drones, neighbours)

    def _receive(self, vehicle, parameters, drones, command):
        """The commands that reach the rate controllers, and the drones with the memory of it."""
        contexts = self._contexts(vehicle, drones, self.dt)
        change = functools.partial(composition.change_command, self.effects)
        axes = (_drones_axis(parameters), 0, 0, 0)
        command, memory = jax.vmap(change, axes)(parameters, drones.effect_memory, command, contexts)
        return command, drones.replace(effect_memory=memory)

    def _substep(self, vehicle, parameters, drones, command, pillar_position, pillar_active):
        dt = self.dt / self.substeps
        contexts = self._contexts(vehicle, drones, dt) if self.effects else None
        axes = (_vehicles_axis(vehicle), _drones_axis(parameters), 0, 0, 0)
        around = None
        if self.contacts and self.physics != "stops":
            around = surroundings(drones.position, drones.velocity, pillar_position, pillar_active)
        if self.physics != "mjx":
            move = jax.vmap(self._rigid_substep, (*axes, None if around is None else 0))
            return move(vehicle, parameters, drones, command, contexts, around)
        motors = functools.partial(self._motors, dt=dt)
        moved, force, torque = jax.vmap(motors, axes)(vehicle, parameters, drones, command, contexts)
        body = (drones.position, drones.quaternion, drones.velocity, drones.body_rates, force, torque)
        world, shapes = make_world(self.arena, 0, 0, dt, False), None
        if self.contacts:
            world = make_world(self.arena, pillar_position.shape[0], drones.position.shape[0] - 1, dt, True)
            met = jax.vmap(functools.partial(encounters, self.arena, dt=dt))
            shapes = jax.vmap(place_solids)(met(drones.position, drones.velocity, around))
        axes = (axes[0], None if shapes is None else 0, *(0 for _ in body))
        move = functools.partial(mjx_step, world, dt=dt)
        return _with_body(moved, jax.vmap(move, axes)(vehicle, shapes, *body))

    def _rigid_substep(self, vehicle, parameters, drone, command, context, around: Surroundings | None):
        """One drone after a substep of `rigid`, in free flight if nothing is around."""
        dt = self.dt / self.substeps
        moved, force, torque = self._motors(vehicle, parameters, drone, command, context, dt)
        body = (drone.position, drone.quaternion, drone.velocity, drone.body_rates, force, torque)
        contact = None
        if around is not None:

            def contact(free):
                return contact_acceleration(self.arena, drone.position, drone.velocity, free, around, dt)

        return _with_body(moved, rigid_step(vehicle, *body, dt, contact))

    def _plain_substep(self, vehicle, drone, command, around):
        """One drone after a substep of `rigid` without effects."""
        return self._rigid_substep(vehicle, {}, drone, command, None, around)

    def _motors(self, vehicle, parameters, drone, command, context, dt):
        """One drone up to the wrench on its body: its new controller and rotors, force world, torque body."""
        motor_command, integral = rate_controller(vehicle, drone, command, dt)
        if self.effects:
            motor_command = composition.change_motor_command(self.effects, parameters, motor_command, context)
        speed = rotor_speed_step(vehicle, drone.rotor_speed, motor_command, dt)
        thrust, reaction = rotor_thrust(vehicle, speed), rotor_reaction(vehicle, speed)
        if self.effects:
            context = context.replace(rotor_speed=speed, thrust=thrust)
            thrust, reaction = composition.change_thrust(self.effects, parameters, thrust, reaction, context)
            context = context.replace(thrust=thrust)
        force, torque = total_wrench(vehicle, thrust, reaction)
        if self.effects:
            more_force, more_torque = composition.added_wrench(self.effects, parameters, context)
            force, torque = force + more_force, torque + more_torque
        drone = drone.replace(rotor_speed=speed, rate_integral=integral, previous_body_rates=drone.body_rates)
        return drone, rotate(drone.quaternion, force), torque


def _drones_axis(parameters):
    """0 where the effects' parameters are those of each drone, None where all drones share them."""
    return 0 if any(leaf.ndim for leaf in jax.tree.leaves(parameters)) else None


def _vehicles_axis(vehicle):
    """0 where the leaves of `vehicle` are those of each drone, None where all drones are alike."""
    return 0 if vehicle.mass.ndim else None


def _with_body(drone, body):
    """`drone` with the position, quaternion, velocity and body rates of `body`."""
    position, quaternion, velocity, body_rates = body
    return drone.replace(position=position, quaternion=quaternion, velocity=velocity, body_rates=body_rates)


def make_drones_step(
    physics: str = "mjx",
    dt: float = 0.01,
    substeps: int = 1,
    effects=(),
    contacts: bool = True,
    max_pillars: int | None = None,
    num_drones: int | None = None,
    arena: Arena = Arena(),  # noqa: B008
) -> DronesStep:
    """Make the step of N drones of one world.

    physics "mjx": MuJoCo MJX; "rigid": the same equations written out, many times faster. In both floor, pillars
    (of the `arena`'s sizes) and other drones are solid unless `contacts` is off. "stops": free
    flight, and drones are put back out of solid things once per step. dt is the step
    in seconds; `substeps` divide it, and the rate controller runs in each. `effects` (names or `Effect`s) are modelled
    beyond the nominal vehicle. Within a substep: controller on the present state, motors, rotor speeds,
    wrench from the updated rotor speeds, body.

    Sizes are those of the arrays that the step gets; with `max_pillars` and `num_drones` the MJX model for
    them is built here instead of at the first step. Raises UserError for unknown physics or effects and
    impossible steps.
    """
    if physics not in PHYSICS:
        raise UserError(f"physics {physics!r} is unknown; one of {', '.join(PHYSICS)} would be right")
    if substeps < 1 or dt <= 0:
        raise UserError(f"dt {dt} with {substeps} substeps: dt > 0 and substeps >= 1 would be right")
    if physics == "mjx" and contacts and max_pillars is not None and num_drones is not None:
        make_world(arena, max_pillars, num_drones - 1, dt / substeps, True)
    return DronesStep(physics, dt, substeps, contacts, arena, composition.resolve(effects))
