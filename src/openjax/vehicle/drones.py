"""The step of N drones in one world: controller, motors, effects, body."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from openjax.errors import UserError
from openjax.vehicle.arena import Arena
from openjax.vehicle.bodies import Bodies, vehicles_axis
from openjax.vehicle.effects import composition
from openjax.vehicle.effects.effect import Context, Effect, make_context
from openjax.vehicle.mjx_body import make_world
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rigid_body import accelerations, rotate
from openjax.vehicle.rigid_kernel import FusedStep, step_many
from openjax.vehicle.rotors import rotor_speed_step
from openjax.vehicle.shapes import Active, Command, Commands, Pillars, Seconds, Vector
from openjax.vehicle.solids import others
from openjax.vehicle.state import DroneState
from openjax.vehicle.stops import stop

PHYSICS = ("mjx", "rigid", "stops")


def motors(
    effects: tuple[Effect, ...],
    vehicle: Vehicle,
    parameters: Mapping,
    drone: DroneState,
    command: Command,
    context: Context | None,
    dt: Seconds,
) -> tuple[DroneState, Vector, Vector]:
    """One drone up to the wrench on its body, its controller and rotors dt seconds
    later.

    Args:
      effects: those that act, with their `parameters` {effect: {name: ()}}.
      vehicle: that really flies.
      drone: before the substep.
      command: (4,) as for `rate_controller`.
      context: of the effects; None without any.
      dt: seconds.

    Returns:
      the drone with its new rotors and controller, force (3,) N in the world without
      gravity, torque (3,) N m about the centre of mass, body frame.
    """
    motor_command, integral = rate_controller(vehicle, drone, command, dt)
    motor_command = composition.change_motor_command(effects, parameters, motor_command, context)
    speed = rotor_speed_step(vehicle, drone.rotor_speed, motor_command, dt)
    force, torque = composition.wrench(effects, parameters, vehicle, speed, context)
    drone = drone.replace(
        rotor_speed=speed, rate_integral=integral, previous_body_rates=drone.body_rates
    )
    return drone, rotate(drone.quaternion, force), torque


@dataclass(frozen=True)
class DronesStep:
    """The step of N drones of one world, made by `make_drones_step`. Its methods are
    pure, to be mapped.
    """

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
        command: Commands,
        pillar_position: Pillars,
        pillar_active: Active,
        effect_parameters: Mapping | None = None,
    ) -> DroneState:
        """`drones` (leading axis N) after one step of `dt` seconds.

        command (N, 4) as for `rate_controller`, pillar_position (P, 2) m, pillar_active
        (P,) bool, effect_parameters {effect: {parameter: () or (N,) array}} for the
        effects of this step, of all drones or of each; what is left out has no effect.
        The arithmetic is done in the precision of the drones' state.

        Raises:
          UserError: parameters of other effects than this step's, or drones without the
          memory of its effects.
        """
        dtype = drones.position.dtype
        vehicle = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), vehicle)
        command = jnp.asarray(command, dtype)
        # the plain step of training has a kernel of its own; with effects it is put
        # together below
        if self.physics == "rigid" and not self.effects:
            memory = drones.effect_memory  # of other effects than this step's, if any
            # one kernel holds the motors, the body and its contacts
            around = (pillar_position, pillar_active) if self.contacts else None
            drones = step_many(
                self.fused_step, vehicle, drones.replace(effect_memory=()), command, around
            )
            return drones.replace(effect_memory=memory)

        composition.check_memory(self.effects, drones.effect_memory)
        parameters = self._parameters(effect_parameters, drones)
        vehicle = self._body(vehicle, parameters)
        # once per step, not per substep: a radio sends one command for all of them
        command, drones = self._receive(vehicle, parameters, drones, command)

        def substep(drones):
            drones, force, torque = self._turn_motors(vehicle, parameters, command, drones)
            around = self._bodies.around(drones, pillar_position, pillar_active)
            return self._bodies(vehicle, drones, force, torque, around)

        drones = _repeat(substep, drones, self.substeps)
        if self.physics == "stops":
            drones = stop(self.arena, drones, pillar_position, pillar_active)
        return self._remember(drones)

    @property
    def fused_step(self) -> FusedStep:
        """`rigid` without effects, for `step_many`."""
        return FusedStep(self._accelerate, self.arena, self._bodies.dt, self.substeps)

    def reset(self, vehicle: Vehicle, drones: DroneState, key=None) -> DroneState:
        """`drones` (leading axis N) with the effects' memory as at the start of an
        episode.

        Raises:
          UserError: an effect is random and there is no `key`.
        """
        number = jnp.arange(drones.position.shape[0])

        def memory(drone, n):
            # by number, so that what a drone draws doesn't depend on how many there are
            drone_key = None if key is None else jax.random.fold_in(key, n)
            return composition.initial_memory(self.effects, vehicle, drone, self.dt, drone_key)

        return drones.replace(effect_memory=jax.vmap(memory)(drones, number))

    def seen(self, drones: DroneState, effect_parameters=None) -> DroneState:
        """The off-board controller's view of `drones` (leading axis N): the drones themselves
        without sensor effects.
        """
        if not self.effects:
            return drones
        parameters = self._parameters(effect_parameters, drones)
        see = functools.partial(composition.seen_state, self.effects)
        return jax.vmap(see)(parameters, drones)

    @property
    def _bodies(self) -> Bodies:
        """The motion of the bodies in a substep."""
        return Bodies(self.physics, self.contacts, self.arena, self.dt / self.substeps)

    def _parameters(self, values, drones):
        """Parameters (N,) of every effect."""
        parameters = composition.complete_parameters(self.effects, values, drones.position.dtype)
        number = drones.position.shape[0]
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (number,)), parameters)

    def _body(self, vehicle, parameters):
        """The vehicles that really fly: with effects, every leaf has the drones' axis
        first.
        """
        change = functools.partial(composition.change_body, self.effects)
        return jax.vmap(change, (0, None))(parameters, vehicle) if self.effects else vehicle

    def _contexts(self, vehicle, drones, dt) -> Context:
        neighbours = drones.position[others(drones.position.shape[0])]

        def context(vehicle, drone, neighbour):
            return make_context(
                vehicle,
                drone,
                others_position=neighbour,
                air_time=composition.air_time(self.effects, drone.effect_memory),
                ceiling_height=self.arena.height,
                dt=dt,
            )

        return jax.vmap(context, (vehicles_axis(vehicle), 0, 0))(vehicle, drones, neighbours)

    def _receive(self, vehicle, parameters, drones, command):
        """The commands that reach the rate controllers, and the drones with the memory
        of it.
        """
        contexts = self._contexts(vehicle, drones, self.dt)
        change = functools.partial(composition.change_command, self.effects)
        command, memory = jax.vmap(change)(parameters, drones.effect_memory, command, contexts)
        return command, drones.replace(effect_memory=memory)

    def _turn_motors(self, vehicle, parameters, command, drones):
        """The drones with their rotors a substep later, and the force and torque on
        each.
        """
        dt = self.dt / self.substeps
        contexts = self._contexts(vehicle, drones, dt)
        turn = functools.partial(motors, self.effects, dt=dt)
        turn = jax.vmap(turn, (vehicles_axis(vehicle), 0, 0, 0, 0))
        return turn(vehicle, parameters, drones, command, contexts)

    def _accelerate(self, vehicle, drone, command):
        """One drone without effects up to its accelerations in free flight; see
        `FusedStep`.
        """
        drone, force, torque = motors((), vehicle, {}, drone, command, None, self._bodies.dt)
        acceleration, angular = accelerations(vehicle, drone, force, torque)
        return drone, acceleration, angular

    def _remember(self, drones):
        """The drones with the effects' memory at the end of a step."""
        record = functools.partial(composition.record, self.effects, dt=self.dt)
        return drones.replace(effect_memory=jax.vmap(record)(drones.effect_memory, drones))


def _repeat(substep, drones, number):
    """`drones` after so many substeps; a single one isn't worth a loop."""
    if number == 1:
        return substep(drones)
    drones, _ = jax.lax.scan(lambda drones, _: (substep(drones), None), drones, length=number)
    return drones


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

    Within a substep: controller on the present state, motors, rotor speeds, wrench from
    the updated rotor speeds, body.

    Args:
      physics: "mjx": MuJoCo MJX. "rigid": the same equations written out, many times
      faster. In both floor, pillars and other drones are solid. "stops": free flight,
      and drones are put back out of solid things once per step.
      dt: seconds of a step.
      substeps: by which it is divided; the rate controller runs in each.
      effects: beyond the nominal vehicle, by name or of type `Effect`.
      contacts: off: nothing is solid.
      max_pillars, num_drones: with both, the MJX model for so many is built here
      instead of at the first step. Sizes otherwise are those of the arrays that the
      step gets.
      arena: sizes the pillars.

    Raises:
      UserError: unknown physics or effects, or an impossible step.
    """
    if physics not in PHYSICS:
        raise UserError(
            f"physics {physics!r} is unknown; one of {', '.join(PHYSICS)} would be right"
        )
    if substeps < 1 or dt <= 0:
        raise UserError(
            f"dt {dt} with {substeps} substeps: dt > 0 and substeps >= 1 would be right"
        )
    if physics == "mjx" and contacts and max_pillars is not None and num_drones is not None:
        make_world(arena, max_pillars, num_drones - 1, dt / substeps, True)
    return DronesStep(physics, dt, substeps, contacts, arena, composition.resolve(effects))
