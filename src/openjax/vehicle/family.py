"""Families of vehicles: ranges from which the parameters of effects are drawn, one vehicle per pursuer and episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.vehicle.disturbances import DISTURBANCES
from openjax.vehicle.effects.effect import Effect, Parameter
from openjax.vehicle.effects.registry import EFFECTS


class VehicleRange(NamedTuple):
    """Where one parameter of an effect is drawn from: uniformly in its range, now and then in a wider one."""

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
    """The effect and the parameter behind `effect.parameter`. Raises UserError if there is none."""
    effect_name, _, parameter = name.partition(".")
    effect = known_effects().get(effect_name)
    if effect is None:
        raise UserError(f"vehicles: effect {effect_name!r} is unknown; known: {', '.join(known_effects())}")
    if parameter not in effect.parameters:
        raise UserError(
            f"vehicles: effect {effect_name!r} has no parameter {parameter!r}; it has {', '.join(effect.parameters)}"
        )
    return effect, effect.parameters[parameter]


def check_ranges(ranges: Sequence[VehicleRange]) -> None:
    """Raises UserError for unknown parameters, parameters that come twice and ranges that aren't."""
    seen = set()
    for name, low, high, rare_low, rare_high in ranges:
        find_parameter(name)
        if name in seen:
            raise UserError(f"vehicles: {name} comes twice")
        seen.add(name)
        if not (
            np.isfinite([low, high, rare_low, rare_high]).all() and low <= high and rare_low <= rare_high
        ):
            raise UserError(
                f"vehicles: {name} lies in {low}..{high}, rarely {rare_low}..{rare_high}; bounds must rise"
            )


def family_effects(ranges: Sequence[VehicleRange]) -> tuple[Effect, ...]:
    """The effects that a family's vehicles fly with, by name."""
    effects = {find_parameter(entry[0])[0].name: find_parameter(entry[0])[0] for entry in ranges}
    return tuple(effects[name] for name in sorted(effects))


def family_bounds(ranges: Sequence[VehicleRange]) -> np.ndarray:
    """(R, 4) low, high, rare low and rare high of each range."""
    return np.array([entry[1:] for entry in ranges], np.float32)


def narrowed_bounds(ranges: Sequence[VehicleRange], share) -> jax.Array:
    """(R, 4) bounds of the family of which only this `share` () is left about the nominal vehicle."""
    none = np.array([[find_parameter(entry[0])[1].none] for entry in ranges], np.float32)
    return none + share * (family_bounds(ranges) - none)


def draw_vehicles(
    ranges: Sequence[VehicleRange],
    key: jax.Array,
    number: int,
    rare: float = 0.0,
    bounds: jax.Array | None = None,
) -> dict[str, dict[str, jax.Array]]:
    """Effect parameters {effect: {parameter: (number,)}} of `number` vehicles, each drawn by itself.

    With probability `rare` one effect of a vehicle, any with equal odds, is drawn from its rare bounds. `bounds` (R, 4)
    take the place of those in `ranges`: they may be known only after the program was compiled.
    """
    if not ranges:
        return {}
    names = [effect.name for effect in family_effects(ranges)]
    bounds = family_bounds(ranges) if bounds is None else bounds
    owner = np.array([names.index(entry[0].partition(".")[0]) for entry in ranges])
    value_key, chosen_key, rare_key = jax.random.split(key, 3)
    share = jax.random.uniform(value_key, (number, len(ranges)))
    chosen = jax.random.randint(chosen_key, (number,), 0, len(names))
    chosen = jnp.where(jax.random.uniform(rare_key, (number,)) < rare, chosen, -1)
    rarely = chosen[:, None] == owner
    low = jnp.where(rarely, bounds[:, 2], bounds[:, 0])
    high = jnp.where(rarely, bounds[:, 3], bounds[:, 1])
    values = low + share * (high - low)
    drawn: dict[str, dict[str, jax.Array]] = {name: {} for name in names}
    for i, entry in enumerate(ranges):
        effect, _, parameter = entry[0].partition(".")
        drawn[effect][parameter] = values[:, i]
    return drawn


def standard_parameters(ranges: Sequence[VehicleRange], parameters: dict) -> jax.Array:
    """(N, R) parameters of `ranges` in units of their effects' usual ranges, zero where there is no effect.

    The units don't depend on the family's bounds, so that a network that has learnt one family can be shown another.
    """
    columns = []
    for entry in ranges:
        effect, _, name = entry[0].partition(".")
        usual = find_parameter(entry[0])[1]
        half = 0.5 * (usual.prior[1] - usual.prior[0])
        columns.append((parameters[effect][name] - usual.none) / half)
    return jnp.stack(columns, axis=-1)


_LINK = "Crazyradio and ROS bridges: 4-60 ms, 1-50 % of the packets lost in crowded rooms"
_POSE = "motion capture, filtering and network: 4-60 ms"
_ROTORS = (
    "rotor speeds logged on real Crazyflies: effective lags of 66-102 ms (brushed), 38-70 ms (brushless)"
)
_DRAG = "d/m = .38-.41 1/s in public flights of Crazyflies (d = .010-.013 N s/m); literature .005-.03"
_SPREAD = "spread between motors, propellers and batteries of one type; trims shift by 1-2 % from day to day"
_THRUST = "published thrust maps of the Crazyflie"

FLIGHT_SOURCES: dict[str, tuple[float, float, float, float, str]] = {
    "mass.extra": (-0.003, 0.004, -0.005, 0.007, "27-42 g with decks and batteries, nominal 32.1 g"),
    "thrust_scale.scale": (-0.06, 0.06, -0.15, 0.15, _THRUST),
    "thrust_curve.offset": (-0.01, 0.01, -0.03, 0.03, _THRUST),
    "thrust_curve.slope": (0.97, 1.03, 0.9, 1.1, _THRUST),
    "thrust_curve.curvature": (-0.04, 0.04, -0.12, 0.12, _THRUST),
    "thrust_saturation.limit": (
        0.92,
        1.0,
        0.75,
        1.0,
        "brushed motors on a worn battery top out 10-30 % early",
    ),
    "battery_sag.exponent": (0.0, 1.0, 0.5, 2.0, "0 with compensation of the voltage, 2 without"),
    "battery_sag.full": (3.75, 4.15, 3.6, 4.15, "one-cell LiPo under load"),
    "motor_lag.extra_up": (0.0, 0.06, 0.03, 0.077, _ROTORS),
    "motor_lag.extra_down": (0.0, 0.065, 0.03, 0.077, _ROTORS),
    "motor_imbalance.m1": (-0.02, 0.02, -0.11, 0.11, _SPREAD),
    "motor_imbalance.m2": (-0.02, 0.02, -0.11, 0.11, _SPREAD),
    "motor_imbalance.m3": (-0.02, 0.02, -0.11, 0.11, _SPREAD),
    "motor_imbalance.m4": (-0.02, 0.02, -0.11, 0.11, _SPREAD),
    "com_offset.x": (-0.001, 0.001, -0.006, 0.006, "battery and decks shift it by .05-8 mm"),
    "com_offset.y": (-0.001, 0.001, -0.006, 0.006, "battery and decks shift it by .05-8 mm"),
    "com_offset.z": (-0.004, 0.004, -0.008, 0.008, "battery and decks shift it by .05-8 mm"),
    "inertia.xx": (0.85, 1.25, 0.7, 1.6, "identified inertias of Crazyflies with decks"),
    "inertia.yy": (0.85, 1.25, 0.7, 1.6, "identified inertias of Crazyflies with decks"),
    "inertia.zz": (0.85, 1.25, 0.7, 1.6, "identified inertias of Crazyflies with decks"),
    "yaw_torque.ratio": (0.15, 1.1, 0.15, 1.7, "torque per thrust of .005-.007 m measured, .031 m nominal"),
    "rate_gains.p": (0.85, 1.2, 0.6, 1.65, "gains that users tune"),
    "rate_gains.i": (0.8, 1.25, 0.6, 1.65, "gains that users tune"),
    "rate_gains.d": (0.8, 1.25, 0.6, 1.65, "gains that users tune"),
    "rotor_drag.d_xy": (0.0, 0.015, 0.005, 0.03, _DRAG),
    "rotor_drag.d_z": (0.0, 0.015, 0.0, 0.03, _DRAG),
    "blade_flapping.tilt": (0.0, 0.01, 0.0, 0.03, "tilt of the tip-path plane (Mahony, Kumar, Corke 2012)"),
    "blade_flapping.stiffness": (0.0, 5e-5, 0.0, 2.5e-4, "hub moment (Hoffmann et al. 2007)"),
    "wind.x": (-0.3, 0.3, -2.0, 2.0, "indoor draughts and fans, .3-3 m/s"),
    "wind.y": (-0.3, 0.3, -2.0, 2.0, "indoor draughts and fans, .3-3 m/s"),
    "wind.drag": (0.0, 0.01, 0.005, 0.02, "as for rotor drag"),
    "gust.x": (-0.006, 0.006, -0.02, 0.02, "some 1-3 % of the weight"),
    "gust.y": (-0.006, 0.006, -0.02, 0.02, "some 1-3 % of the weight"),
    "gust.z": (-0.006, 0.006, -0.02, 0.02, "some 1-3 % of the weight"),
    "gust.rate": (0.5, 6.0, 0.5, 6.0, "unsteady air of a room"),
    "gust.phase": (0.0, 6.28, 0.0, 6.28, "any"),
    "ground_effect.strength": (
        0.0,
        0.6,
        0.2,
        1.2,
        "5-25 % at 5 cm (Cheeseman-Bennett; Sanchez-Cuevas et al. 2017)",
    ),
    "ground_effect.offset": (0.0, 0.02, 0.0, 0.03, "rotors above the tracked point"),
    "downwash.force": (
        0.0,
        0.08,
        0.05,
        0.17,
        "3-20 g under another Crazyflie (Neural-Swarm; Preiss et al. 2017)",
    ),
    "downwash.length": (0.3, 0.8, 0.2, 1.0, "decay below the other vehicle"),
    "command_latency.delay": (0.0, 0.02, 0.01, 0.05, _LINK),
    "command_jitter.longest": (0.0, 0.004, 0.0, 0.01, _LINK),
    "packet_loss.probability": (0.0, 0.05, 0.02, 0.4, _LINK),
    "state_latency.delay": (0.0, 0.02, 0.01, 0.05, _POSE),
    "view_noise.position": (0.0, 0.0015, 0.0, 0.003, "motion capture: about 1 mm"),
    "view_noise.velocity": (0.0, 0.02, 0.0, 0.05, "differences of positions at 100 Hz, filtered"),
    "view_noise.attitude": (0.0, 0.008, 0.0, 0.02, "about .5 degrees"),
    "view_noise.jitter": (0.0, 0.004, 0.0, 0.01, _POSE),
}
"""The family of the preset `flight`: low, high, rare low, rare high, and where that is known from."""

FLIGHT_FAMILY: tuple[VehicleRange, ...] = tuple(
    VehicleRange(name, *entry[:4]) for name, entry in FLIGHT_SOURCES.items()
)


REST = 0.35
"""The part of `FLIGHT_FAMILY`'s ranges that remains for what a diagnosis didn't find."""


def adapted_family(
    values: dict[str, dict[str, float]],
    intervals: dict[str, dict[str, tuple[float, float]]],
    rest: float = REST,
) -> tuple[VehicleRange, ...]:
    """The family of one vehicle that was diagnosed: what was found, within its intervals, and a share of all else.

    It holds every parameter there is, so that families of any two diagnoses differ in their bounds only.

    Args:
      values: {effect: {parameter: value}} of the effects that were found.
      intervals: their 90 % intervals, where known; else a tenth of the value either way.
      rest: the part of `FLIGHT_FAMILY`'s ranges that remains for effects that weren't found: flights can't rule them out.
    """
    family = []
    for effect in known_effects().values():
        found = values.get(effect.name)
        for key, parameter in effect.parameters.items():
            name = f"{effect.name}.{key}"
            if found is None:
                low, high = FLIGHT_SOURCES.get(name, (parameter.none, parameter.none))[:2]
                low, high = (parameter.none + rest * (bound - parameter.none) for bound in (low, high))
            else:
                value = found.get(key, parameter.none)
                margin = 0.1 * abs(value - parameter.none)
                low, high = intervals.get(effect.name, {}).get(key, (value - margin, value + margin))
            family.append(VehicleRange(name, float(low), float(high), float(low), float(high)))
    return tuple(family)
