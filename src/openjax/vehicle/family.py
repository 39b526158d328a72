"""Families of vehicles: ranges from which the parameters of effects are drawn, one
vehicle per pursuer and episode.
"""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.files import read_toml
from openjax.vehicle.disturbances import DISTURBANCES
from openjax.vehicle.effects.effect import Effect, Parameter
from openjax.vehicle.effects.registry import EFFECTS, find_effect
from openjax.vehicle.parameters import NOMINAL, find_mjcf

REST = 0.35
"""The part of the family's ranges that remains for what a diagnosis didn't find: it
can't rule out that a little of it acts.
"""


class VehicleRange(NamedTuple):
    """The range of one parameter of an effect: drawn uniformly, now and then from a wider one."""

    parameter: str
    """`effect.parameter`, for example `motor_lag.extra_up`."""
    low: float
    high: float
    rare_low: float
    """Bounds for the one effect of a vehicle that is out of the ordinary, if any is."""
    rare_high: float


def known_effects() -> dict[str, Effect]:
    """Effects that a family may hold: those of the diagnosis and the random ones."""
    return {**EFFECTS, **DISTURBANCES}


def find_parameter(name: str) -> tuple[Effect, Parameter]:
    """The effect and the parameter behind `effect.parameter`. Raises UserError if there
    is none.
    """
    effect_name, _, parameter = name.partition(".")
    effect = find_effect(effect_name, parameter, "vehicles: ", known_effects())
    return effect, effect.parameters[parameter]


def checked_ranges(entries: Iterable[Iterable]) -> tuple[VehicleRange, ...]:
    """The ranges that entries (parameter, low, high, rare low, rare high) hold: files
    and settings that a person writes have plain tuples.

    Raises:
      UserError: an unknown parameter, one that comes twice, or a range that isn't.
    """
    ranges = tuple(VehicleRange._make(entry) for entry in entries)
    names = set()
    for name, low, high, rare_low, rare_high in ranges:
        _, parameter = find_parameter(name)
        if name in names:
            raise UserError(f"vehicles: {name} comes twice")
        names.add(name)
        if not (
            np.isfinite([low, high, rare_low, rare_high]).all()
            and low <= high
            and rare_low <= rare_high
        ):
            raise UserError(
                f"vehicles: {name} lies in {low}..{high}, rarely {rare_low}..{rare_high}; bounds "
                "must rise"
            )
        least, most = parameter.limits()
        if min(low, rare_low) < least or max(high, rare_high) > most:
            raise UserError(
                f"vehicles: {name} lies in {low}..{high}, rarely {rare_low}..{rare_high}; it can't "
                f"leave {least:g}..{most:g}"
            )
    return ranges


def family_effects(ranges: Sequence[VehicleRange]) -> tuple[Effect, ...]:
    """The effects that a family's vehicles fly with, by name."""
    effects = {}
    for entry in ranges:
        effect, _ = find_parameter(entry.parameter)
        effects[effect.name] = effect
    return tuple(effects[name] for name in sorted(effects))


def family_bounds(ranges: Sequence[VehicleRange]) -> np.ndarray:
    """(R, 4) low, high, rare low and rare high of each range."""
    return np.array([entry[1:] for entry in ranges], np.float32)


def narrowed_bounds(ranges: Sequence[VehicleRange], share) -> jax.Array:
    """(R, 4) bounds of the family of which only this `share` () is left about the
    nominal vehicle.
    """
    parameters = [find_parameter(entry.parameter)[1] for entry in ranges]
    # about the nominal vehicle, not about the range's middle: a family needn't hold it
    # in the middle
    none = np.array([[parameter.none] for parameter in parameters], np.float32)
    return none + share * (family_bounds(ranges) - none)


def partly_nominal(ranges: Sequence[VehicleRange], worlds: int, share: float) -> jax.Array:
    """(W, R, 4) bounds of the family for each world; this share of them has nominal
    vehicles.
    """
    if not ranges:
        return jnp.zeros((worlds, 0, 4))
    is_nominal = jnp.arange(worlds)[:, None, None] < share * worlds
    nominal = narrowed_bounds(ranges, 0.0)
    return jnp.where(is_nominal, nominal, jnp.asarray(family_bounds(ranges)))


def draw_vehicles(
    ranges: Sequence[VehicleRange],
    key: jax.Array,
    number: int,
    rare: float = 0.0,
    bounds: jax.Array | None = None,
) -> dict[str, dict[str, jax.Array]]:
    """Effect parameters {effect: {parameter: (number,)}} of `number` vehicles, each
    drawn by itself.

    With probability `rare` one effect of a vehicle, any with equal odds, is drawn from
    its rare bounds. `bounds` (R, 4) take the place of those in `ranges`: they may be
    known only after the program was compiled.
    """
    if not ranges:
        return {}
    names = [effect.name for effect in family_effects(ranges)]
    bounds = family_bounds(ranges) if bounds is None else bounds
    owner = np.array([names.index(entry.parameter.partition(".")[0]) for entry in ranges])
    value_key, chosen_key, rare_key = jax.random.split(key, 3)
    # one draw serves both widths: which of them holds is chosen afterwards
    share = jax.random.uniform(value_key, (number, len(ranges)))
    quantity = jax.random.randint(chosen_key, (number,), 0, len(names))
    # -1 is no effect's place: nothing of such a vehicle is out of the ordinary
    quantity = jnp.where(jax.random.uniform(rare_key, (number,)) < rare, quantity, -1)
    is_rare = quantity[:, None] == owner
    low = jnp.where(is_rare, bounds[:, 2], bounds[:, 0])
    high = jnp.where(is_rare, bounds[:, 3], bounds[:, 1])
    values = low + share * (high - low)
    draws: dict[str, dict[str, jax.Array]] = {name: {} for name in names}
    for i, entry in enumerate(ranges):
        effect, _, parameter = entry.parameter.partition(".")
        draws[effect][parameter] = values[:, i]
    return draws


def standard_parameters(ranges: Sequence[VehicleRange], parameters: dict) -> jax.Array:
    """(N, R) parameters of `ranges` in units of their effects' usual ranges, zero where
    there is no effect.

    The units don't depend on the family's bounds, so that a network that has learnt one
    family can be shown another.
    """
    columns = []
    for entry in ranges:
        effect, _, name = entry.parameter.partition(".")
        _, parameter = find_parameter(entry.parameter)
        low, high = parameter.prior
        columns.append((parameters[effect][name] - parameter.none) / (0.5 * (high - low)))
    return jnp.stack(columns, axis=-1)


@functools.cache
def vehicle_family(airframe: str = NOMINAL) -> tuple[VehicleRange, ...]:
    """The family of an airframe: what its vehicles differ by, from `assets`, which has
    the sources.

    Raises:
      UserError: no such airframe, or its file holds no ranges.
    """
    mjcf = find_mjcf(airframe)
    path = mjcf.with_name(f"{mjcf.stem}_family.toml")
    family = []
    try:
        for effect, parameters in read_toml(path, "family of vehicles").items():
            for name, entry in parameters.items():
                bounds = map(float, (*entry["range"], *entry["rare"]))
                family.append((f"{effect}.{name}", *bounds))
        return checked_ranges(family)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise UserError(
            f"{path}: each [effect.parameter] needs range and rare, of two numbers each"
        ) from None


def adapted_family(
    values: dict[str, dict[str, float]],
    intervals: dict[str, dict[str, tuple[float, float]]],
    rest: float = REST,
    airframe: str = NOMINAL,
) -> tuple[VehicleRange, ...]:
    """The family of one vehicle that was diagnosed: what was found, within its
    intervals, and a share of all else.

    It holds every parameter there is, so that families of any two diagnoses differ in
    their bounds only.

    Args:
      values: {effect: {parameter: value}} of the effects that were found.
      intervals: their 90 % intervals, where known; else a tenth of the value either
      way.
      rest: the part of the airframe's family that remains for effects that weren't
      found: flights can't rule them out.
      airframe: that was diagnosed.
    """
    usual = {entry.parameter: entry for entry in vehicle_family(airframe)}
    family = []
    for effect in known_effects().values():
        estimate = values.get(effect.name)
        for key, parameter in effect.parameters.items():
            name = f"{effect.name}.{key}"
            none = parameter.none
            if estimate is None:
                # an effect that the airframe's family lacks stays as the nominal
                # vehicle has it
                usual_range = usual.get(name, VehicleRange(name, none, none, none, none))
                low = none + rest * (usual_range.low - none)
                high = none + rest * (usual_range.high - none)
            else:
                value = estimate.get(key, none)
                margin = 0.1 * abs(value - none)
                about = (value - margin, value + margin)
                low, high = intervals.get(effect.name, {}).get(key, about)
            # one vehicle has no rare cousins: the wider range is the same
            family.append(VehicleRange(name, float(low), float(high), float(low), float(high)))
    return tuple(family)
