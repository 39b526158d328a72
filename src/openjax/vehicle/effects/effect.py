"""What an effect is: named parameters, and pure functions that hook into the step of one drone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from openjax.vehicle.arena import Arena
from openjax.vehicle.parameters import Vehicle, load_vehicle
from openjax.vehicle.rotors import rotor_thrust
from openjax.vehicle.state import DroneState

ARENA_CEILING = Arena.height  # m


@flax.struct.dataclass
class Context:
    """What surrounds one drone at a moment; the input of most hooks. NaN stands for "not known"."""

    position: jax.Array  # (3,) m, world
    quaternion: jax.Array  # (4,) body to world
    velocity: jax.Array  # (3,) m/s, world
    body_rates: jax.Array  # (3,) rad/s
    rotor_position: jax.Array  # (4, 3) m, body frame, hubs seen from the centre of mass
    rotor_speed: jax.Array  # (4,) rad/s
    thrust: jax.Array  # (4,) N
    others_position: jax.Array  # (M, 3) m, world, the other vehicles; M may be 0
    battery_voltage: jax.Array  # () V under load
    packet_lost: jax.Array  # () 1: this command was lost, 0: it arrived
    air_time: jax.Array  # () s since the start
    floor_height: jax.Array  # () m
    ceiling_height: jax.Array  # () m
    dt: jax.Array  # () s, time until the next call


def make_context(vehicle: Vehicle, state: DroneState, **known) -> Context:
    """The context of one drone in `state`, of which `known` are fields; others are usual, or not
    known.

    For logged flights: map it over the samples, `jax.vmap(lambda state, v: make_context(vehicle,
    state, battery_voltage=v))(states, voltages)`, and map an effect's hooks over the result.
    """
    usual = Context(
        position=state.position,
        quaternion=state.quaternion,
        velocity=state.velocity,
        body_rates=state.body_rates,
        rotor_position=vehicle.rotor_position,
        rotor_speed=state.rotor_speed,
        thrust=rotor_thrust(vehicle, state.rotor_speed),
        others_position=jnp.zeros((0, 3)),
        battery_voltage=jnp.nan,
        packet_lost=jnp.nan,
        air_time=0.0,
        floor_height=0.0,
        ceiling_height=ARENA_CEILING,
        dt=0.01,
    )
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, state.position.dtype), usual.replace(**known)
    )


Domain = tuple[float, float]
# Of strengths, lengths and times; of multiples of what is assumed, less of which no vehicle flies
# with.
NOT_NEGATIVE: Domain = (0.0, np.inf)
RATIO: Domain = (0.05, np.inf)


# By which powers of the vehicle's mass and of its arm what is usual of a parameter grows, by its
# unit: forces are shares of the weight, drag over mass is alike (rotors of larger vehicles push
# more air at the same speed), places of things on a vehicle are shares of its arm. Speeds of the
# air, times, voltages and shares don't grow.
GROWTH = {
    "kg": (1, 0),
    "N": (1, 0),
    "N s/m": (1, 0),
    "N m s/m": (1, 1),
    "m": (0, 1),
}
ALIKE = 2.0  # factor of mass or arm within which a vehicle is a Crazyflie, whose ranges are meant


def growth(unit: str, vehicle: Vehicle) -> float:
    """By what the usual range of a parameter in `unit` is multiplied for a vehicle; 1 for those of
    about a Crazyflie's size.
    """
    if unit not in GROWTH:
        return 1.0
    factor = 1.0
    for power, size in zip(GROWTH[unit], (_mass, _arm), strict=True):
        ratio = size(vehicle) / size(load_vehicle())
        factor *= 1.0 if 1.0 / ALIKE <= ratio <= ALIKE else ratio**power
    return factor


def _mass(vehicle: Vehicle) -> float:
    """kg."""
    return float(np.asarray(vehicle.mass))


def _arm(vehicle: Vehicle) -> float:
    """m, from the centre of mass to a rotor, on the mean."""
    return float(np.linalg.norm(np.asarray(vehicle.rotor_position)[:, :2], axis=1).mean())


@dataclass(frozen=True)
class Parameter:
    """A scalar parameter of an effect.

    none: with every parameter of an effect at this value the effect is absent.
    prior: the usual range (weak, not a bound), in the parameter's unit.
    domain: the range in which it means anything, as numbers or by the vehicle.
    """

    unit: str
    none: float
    prior: tuple[float, float]
    source: str
    meaning: str = ""
    domain: Domain | Callable[[Vehicle], Domain] = (-np.inf, np.inf)

    def usual(self, vehicle: Vehicle) -> tuple[float, float]:
        """The usual range for a vehicle: what differs from `none` grows with it."""
        factor = growth(self.unit, vehicle)
        low, high = (self.none + factor * (end - self.none) for end in self.prior)
        return (low, high) if factor != 1.0 else self.prior

    def limits(self, vehicle: Vehicle | None = None) -> Domain:
        """The domain for a vehicle, by default the nominal one."""
        if not callable(self.domain):
            return self.domain
        return self.domain(load_vehicle() if vehicle is None else vehicle)


@dataclass(frozen=True)
class Fitted:
    """How one parameter is fitted: prior mean and standard deviation, start of the search, step of
    the difference quotient, all in the parameter's unit. `error`: standard deviation that rows of a
    log leave, whatever a fit says.
    """

    name: str
    mean: float
    spread: float
    start: float
    step: float
    error: float = 0.0


# Log prior odds of effects, in round numbers: one vehicle in twenty, one in a hundred and fifty,
# one in four hundred.
UNCOMMON = -3.0
RARE = -5.0
VERY_RARE = -6.0


@dataclass(frozen=True)
class Card:
    """How an effect is told from flights.

    fitted: its parameters; `common` is the spread that all share, `balanced`: their mean belongs to
    another effect and is
        held near zero, `others`: more starts of the search.
    path: by which way of the log it is read: "physics" (motors to motion), "radio", "rate_loop",
    "estimator". needs: the channel without which it can't be told, though it leaves a trace in
    others. needs_force: whether it can't be told without a force, of the path or of an accelerometer.
    coordinate: the variable that its force follows, for pictures; none where it makes
    torques or delays. thrust_map: a map from duty cycles to thrust that isn't known can imitate it.
    torque_axes: those of the torques by which it is told, which what motors do between two rows can
    imitate. log_odds: log prior odds that it acts at a size that matters. possible({parameter:
    value}, {parameter: deviation}): whether fitted values lie within physical bounds. nuisance:
    {parameter: size, or a function of the vehicle that gives it} by which the vehicle's number is
    usually off: free in
        every hypothesis, never a cause.
    nuisance_duty, nuisance_samples: the same where motor commands are duty cycles, or single
    samples whose rows hide the rest. weighed: whether a weighed vehicle rules it out.
    of_others: whether it acts near other vehicles alone.
    at_voltage(values, intervals, voltage): both as they are at one voltage, for simulators that
    know none. practical: {parameter: how far one of them must be
    from doing nothing before anybody would change a simulator for it}. days: of an effect that
    every vehicle has to some degree, the standard deviation of its parameters over a vehicle's
    days; None for others. trim({parameter: value}, vehicle) -> (4,): of an effect that a day's trims
    look like, by which share each rotor seems to push more. sample: a strength within its usual
    range to fly with, strong enough to see.
    impossible(position): whether a flight along position (T, 3), m, rules it out. next_flight: what
    would show it, in words.
    """

    fitted: tuple[Fitted, ...]
    path: str = "physics"
    common: float = 0.0
    balanced: bool = False
    others: tuple[tuple[float, ...], ...] = ()
    needs: str = ""
    needs_force: bool = False
    coordinate: str = ""
    thrust_map: bool = False
    torque_axes: tuple[int, ...] = ()
    log_odds: float = UNCOMMON
    possible: Callable[[Mapping[str, float], Mapping[str, float]], bool] | None = None
    nuisance: Mapping[str, float | Callable[[Vehicle], float]] = field(default_factory=dict)
    nuisance_duty: Mapping[str, float] = field(default_factory=dict)
    nuisance_samples: Mapping[str, float] = field(default_factory=dict)
    weighed: bool = False
    of_others: bool = False
    at_voltage: Callable[[dict, dict, float], tuple[dict, dict]] | None = None
    impossible: Callable[[Any], bool] | None = None
    sample: Mapping[str, float] = field(default_factory=dict)
    practical: Mapping[str, float] = field(default_factory=dict)
    days: float | None = None
    trim: Callable[[Mapping[str, float], Vehicle], Any] | None = None
    next_flight: str = ""


# Hooks of one drone; `parameters` is {name: () array}, `memory` a pytree of arrays.
BodyHook = Callable[[Mapping[str, Any], Vehicle], Vehicle]
CommandHook = Callable[[Mapping[str, Any], Any, jax.Array, Context], tuple[jax.Array, Any]]
MotorHook = Callable[[Mapping[str, Any], jax.Array, Context], jax.Array]
ThrustHook = Callable[
    [Mapping[str, Any], jax.Array, jax.Array, Context], tuple[jax.Array, jax.Array]
]
WrenchHook = Callable[[Mapping[str, Any], Context], tuple[jax.Array, jax.Array]]
SensorHook = Callable[[Mapping[str, Any], Any, DroneState], DroneState]


@dataclass(frozen=True)
class Effect:
    """One physical effect that the nominal vehicle leaves out. Any subset of the hooks may be
    given:

    body(parameters, vehicle) -> vehicle: another vehicle; once per step. command(parameters,
    memory, command (4,), context) -> command, memory: what reaches the rate controller of
        what the off-board controller sent; once per step.
    motor(parameters, motor_command (4,), context) -> motor_command: before the motors' lag.
    thrust(parameters, thrust (4,) N, reaction (4,) N m, context) -> thrust, reaction: of each
    rotor. wrench(parameters, context) -> force (3,) N, torque (3,) N m: added, body frame, about
    the centre of mass. sensor(parameters, memory, state) -> state: what the off-board controller
    sees of the present state. record(memory, state) -> memory: remembers the state at the end of a
    step, for `sensor`. initial_memory(vehicle, state, dt, key) -> memory: needed where `command`,
    `sensor` or `record` use one. random: whether `initial_memory` needs its key. formula: what it
    changes, in LaTeX, for the documentation. card: how the diagnosis tells it; without one it can
    be flown with, but not be diagnosed.
    """

    name: str
    description: str
    parameters: Mapping[str, Parameter]
    body: BodyHook | None = None
    command: CommandHook | None = None
    motor: MotorHook | None = None
    thrust: ThrustHook | None = None
    wrench: WrenchHook | None = None
    sensor: SensorHook | None = None
    record: Callable[[Any, DroneState], Any] | None = None
    initial_memory: Callable[[Vehicle, DroneState, float, Any], Any] | None = None
    random: bool = False
    formula: str = ""
    card: Card | None = None

    def none(self) -> dict[str, float]:
        """Parameters at which the effect is absent."""
        return {name: parameter.none for name, parameter in self.parameters.items()}
