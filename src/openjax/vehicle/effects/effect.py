"""The form of an effect: named parameters, and pure functions that hook into the
step of one drone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.vehicle.arena import Arena
from openjax.vehicle.parameters import Vehicle, load_vehicle
from openjax.vehicle.rotors import rotor_thrust
from openjax.vehicle.state import DroneState

ARENA_CEILING = Arena.height  # m


@flax.struct.dataclass
class Context:
    """The surroundings of one drone at a moment; the input of most hooks. NaN means "not known"."""

    position: jax.Array  # (3,) m, world
    quaternion: jax.Array  # (4,) body to world
    velocity: jax.Array  # (3,) m/s, world
    body_rates: jax.Array  # (3,) rad/s
    inertia: jax.Array  # (3,) kg m^2, principal
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


def make_context(vehicle: Vehicle, state: DroneState, **fields) -> Context:
    """The context of one drone in `state`. `fields`: further fields of `Context`; those
    left out are usual, or not known.

    For logged flights: map it over the samples, `jax.vmap(lambda state, v:
    make_context(vehicle, state, battery_voltage=v))(states, voltages)`, and map an
    effect's hooks over the result.
    """
    usual = Context(
        position=state.position,
        quaternion=state.quaternion,
        velocity=state.velocity,
        body_rates=state.body_rates,
        inertia=vehicle.inertia,
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
        lambda leaf: jnp.asarray(leaf, state.position.dtype), usual.replace(**fields)
    )


Domain = tuple[float, float]
NOT_NEGATIVE: Domain = (0.0, np.inf)
"""Of strengths, lengths and times."""
RATIO: Domain = (0.05, 20.0)
"""Of multiples of what is assumed: no vehicle flies with less than a twentieth or more
than twenty times of it.
"""

# Forces are shares of the weight; drag over mass is alike, since the rotors of larger
# vehicles push more air at the same speed; places of things on a vehicle are shares of
# its arm. Speeds of the air, times, voltages and shares don't grow.
GROWTH = {"kg": (1, 0), "N": (1, 0), "N s/m": (1, 0), "N m s/m": (1, 1), "m": (0, 1)}
"""Unit of a parameter -> powers of the vehicle's mass and of its arm by which its usual
range grows.
"""
ALIKE = 2.0
"""Factor of mass or arm within which a vehicle counts as a Crazyflie, for which ranges
are written.
"""


def growth(unit: str, vehicle: Vehicle) -> float:
    """The factor on the usual range of a parameter in `unit` for a vehicle; 1 for those of about a
    Crazyflie's size.
    """
    if unit not in GROWTH:
        return 1.0
    sizes = (_mass(vehicle), _arm(vehicle))
    factor = 1.0
    for power, size, usual in zip(GROWTH[unit], sizes, _usual_sizes(), strict=True):
        ratio = size / usual
        # another battery or frame guard mustn't shift the ranges of what is still a
        # Crazyflie
        if not 1.0 / ALIKE <= ratio <= ALIKE:
            factor *= ratio**power
    return factor


@cache
def _usual_sizes() -> tuple[float, float]:
    """kg and m: the nominal vehicle's, which every parameter of every fit asks for."""
    nominal = load_vehicle()
    return _mass(nominal), _arm(nominal)


def _mass(vehicle: Vehicle) -> float:
    """kg."""
    return float(np.asarray(vehicle.mass))


def _arm(vehicle: Vehicle) -> float:
    """m, from the centre of mass to a rotor, on the mean."""
    return float(np.linalg.norm(np.asarray(vehicle.rotor_position)[:, :2], axis=1).mean())


@dataclass(frozen=True)
class Parameter:
    """A scalar parameter of an effect."""

    unit: str
    none: float
    """With every parameter of an effect at this value the effect is absent."""
    prior: tuple[float, float]
    """The usual range in the parameter's unit: weak, not a bound."""
    source: str
    """The source of that range."""
    meaning: str = ""
    domain: Domain | Callable[[Vehicle], Domain] = (-np.inf, np.inf)
    """The range in which it means anything, as numbers or by the vehicle."""

    def usual(self, vehicle: Vehicle) -> tuple[float, float]:
        """The usual range for a vehicle: what differs from `none` grows with it."""
        factor = growth(self.unit, vehicle)
        # the written numbers themselves, which arithmetic would round
        if factor == 1.0:
            return self.prior
        low, high = (self.none + factor * (end - self.none) for end in self.prior)
        return low, high

    def limits(self, vehicle: Vehicle | None = None) -> Domain:
        """The domain for a vehicle, by default the nominal one."""
        if not callable(self.domain):
            return self.domain
        return self.domain(load_vehicle() if vehicle is None else vehicle)


Situation = Literal["always", "duty_cycles", "samples"]
"""How motor commands are logged: as duty cycles, as single samples or in any other way."""


@dataclass(frozen=True)
class Nuisance:
    """By how much the vehicle's own number is usually off, in the parameter's unit: free
    in every hypothesis, never a cause.
    """

    always: float | Callable[[Vehicle], float] | None = None
    """A number or a function of the vehicle; None: not at all."""
    duty_cycles: float | None = None
    """Where motor commands are duty cycles; None: as always."""
    samples: float | None = None
    """Where motor commands are single samples, whose rows hide the rest; None: as
    always.
    """

    def size(self, situation: Situation, vehicle: Vehicle) -> float | None:
        """By how much in a situation, for a vehicle; None: not at all."""
        special = getattr(self, situation)
        size = self.always if special is None else special
        return float(size(vehicle)) if callable(size) else size


@dataclass(frozen=True)
class Fitted:
    """The fit of one parameter, and what the diagnosis knows of it; all numbers are in
    its unit.
    """

    name: str
    mean: float
    """Of the prior."""
    spread: float
    """Standard deviation of the prior."""
    start: float
    """The start of the search."""
    step: float
    """Of the difference quotient."""
    error: float = 0.0
    """Standard deviation that the rows of a log leave, whatever a fit says."""
    most: float = float("inf")
    """The end of the search."""
    sample: float | None = None
    """A strength within its usual range to fly with, strong enough to see; None: flown
    as if absent.
    """
    practical: float | None = None
    """How far it must be from doing nothing before anybody would change a simulator for
    it: one such parameter of an effect is enough. None: it doesn't say how much the
    effect does.
    """
    shape: bool = False
    """True if it does nothing by itself, as it only says how the others' push is
    spread. While nothing pushes it can have any value (Davies 1987), so the effect's
    size is asked with it as it was fitted.
    """
    coupling: bool = False
    """True if by it what turns one axis turns another. Lags, clocks and what motors do
    unseen stay on their axis, so the replay alone tells it.
    """
    nuisance: Nuisance = Nuisance()
    """By default the vehicle's own number is known."""


# In round numbers: nobody has counted how often vehicles have an effect.
UNCOMMON = -3.0
"""Log prior odds of an effect that one vehicle in twenty has."""
RARE = -5.0
"""One in a hundred and fifty."""
VERY_RARE = -6.0
"""One in four hundred."""


Need = Literal["position", "velocity", "voltage", "force", "thrust_map"]
"""A channel of a log; a force, of the path or of an accelerometer; or the map from duty
cycles to thrust, which can imitate effects while it isn't known.
"""
Scale = Literal["motion", "torques"]
"""motion: all accelerations. Of two effects that scale them flights show the product
alone, so that no set has both. torques: what thrust a motor command makes, and with it
the gains of all torques, which are then no inertia's.
"""


@dataclass(frozen=True)
class Card:
    """The diagnosis' knowledge of an effect."""

    fitted: tuple[Fitted, ...]
    """Its parameters."""
    path: str = "physics"
    """By which way of the log it is read: "physics" (motors to motion), "radio",
    "rate_loop" or "estimator".
    """
    common: float = 0.0
    """Spread that all its parameters share but those that are a `coupling`."""
    balanced: bool = False
    """True if the mean of its parameters belongs to another effect, and is held near
    zero.
    """
    others: tuple[tuple[float, ...], ...] = ()
    """More starts of the search."""
    needs: tuple[Need, ...] = ()
    """That without which it can't be told, though it leaves a trace elsewhere."""
    coordinate: str = ""
    """The variable that its force follows, for pictures; none where it makes torques or
    delays.
    """
    scales: tuple[Scale, ...] = ()
    """All that it can change in proportion."""
    torque_axes: tuple[int, ...] = ()
    """Axes of the torques by which it is told: what motors do between two rows can
    imitate them.
    """
    log_odds: float = UNCOMMON
    """Log prior odds that it acts at a size that matters."""
    possible: Callable[[Mapping[str, float], Mapping[str, float]], bool] | None = None
    """possible({parameter: value}, {parameter: deviation}): whether fitted values lie
    within physical bounds.
    """
    takes_over: tuple[str, Callable[[Mapping[str, float]], Mapping[str, float]]] | None = None
    """Another effect that a vehicle may always have and that is part of this one, and how that
    one's values {parameter: value} are said by this one's parameters.
    """
    weighed: bool = False
    """True if a weighed vehicle rules it out."""
    of_others: bool = False
    """True if it acts near other vehicles alone."""
    at_voltage: Callable[[dict, dict, float], tuple[dict, dict]] | None = None
    """at_voltage(values, intervals, voltage): both as they are at one voltage, for
    simulators that know none.
    """
    impossible: Callable[[Any], bool] | None = None
    """impossible(position): whether a flight along position (T, 3) m rules it out."""
    departure: Callable[[], Any] | None = None
    """departure() -> (n, p): what a unit of each parameter does in n usual states, such
    that its root sum of squares is 1 where it begins to matter. In place of `practical`
    numbers where no parameter by itself says how much the effect does.
    """
    days: float | None = None
    """Of an effect that every vehicle has to some degree: the standard deviation of its
    parameters over a vehicle's days. None for others.
    """
    trim: Callable[[Mapping[str, float], Vehicle], Any] | None = None
    """trim({parameter: value}, vehicle) -> (4,): of an effect that a day's trims look
    like, by which share each rotor seems to push more.
    """
    next_flight: str = ""
    """The flight that would show it, in words."""

    @property
    def sample(self) -> dict[str, float]:
        """{parameter: value} to fly with; the others as if absent."""
        return {p.name: p.sample for p in self.fitted if p.sample is not None}


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
    """One physical effect that the nominal vehicle leaves out. Any subset of the hooks
    may be given; they stand in the order in which a step calls them.
    """

    name: str
    description: str
    parameters: Mapping[str, Parameter]
    body: BodyHook | None = None
    """(parameters, vehicle) -> vehicle: another vehicle; once per step."""
    command: CommandHook | None = None
    """(parameters, memory, command (4,), context) -> command, memory: what reaches the
    rate controller of what the off-board controller sent; once per step.
    """
    motor: MotorHook | None = None
    """(parameters, motor_command (4,), context) -> motor_command: before the motors'
    lag.
    """
    thrust: ThrustHook | None = None
    """(parameters, thrust (4,) N, reaction (4,) N m, context) -> thrust, reaction: of
    each rotor.
    """
    wrench: WrenchHook | None = None
    """(parameters, context) -> force (3,) N, torque (3,) N m: added, body frame, about
    the centre of mass.
    """
    sensor: SensorHook | None = None
    """(parameters, memory, state) -> state: what the off-board controller sees of the
    present state; whenever it looks.
    """
    record: Callable[[Any, DroneState], Any] | None = None
    """(memory, state) -> memory: remembers the state at the end of a step, for
    `sensor`.
    """
    initial_memory: Callable[[Vehicle, DroneState, float, Any], Any] | None = None
    """(vehicle, state, dt, key) -> memory: needed where `command`, `sensor` or `record`
    use one.
    """
    random: bool = False
    """True if `initial_memory` needs its key."""
    formula: str = ""
    """Its formula in LaTeX, for the documentation."""
    card: Card | None = None
    """The means by which the diagnosis finds it; without one it can be flown with, but not be
    diagnosed.
    """

    def __post_init__(self):
        hooks = {
            "body": self.body,
            "command": self.command,
            "motor": self.motor,
            "thrust": self.thrust,
            "wrench": self.wrench,
            "sensor": self.sensor,
        }
        if not self.name.isidentifier():
            # it is a key of effects.toml and an option of commands
            raise UserError(
                f"effect {self.name!r}: letters, digits and _ would be right in its name"
            )
        if not any(hooks.values()):
            raise UserError(
                f"effect {self.name!r} changes nothing: one of {', '.join(hooks)} is needed"
            )
        remembers = self.command or self.sensor or self.record
        if remembers and self.initial_memory is None:
            raise UserError(
                f"effect {self.name!r}: command, sensor and record remember something; "
                "initial_memory says what at the start"
            )

    def none(self) -> dict[str, float]:
        """Parameters at which the effect is absent."""
        return {name: parameter.none for name, parameter in self.parameters.items()}
