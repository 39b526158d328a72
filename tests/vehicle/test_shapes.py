"""Shapes in types are true: a function that gets arrays of its arguments' types gives
those of its result's.
"""

import dataclasses
import inspect
import typing
from collections.abc import Sequence

import jax.numpy as jnp
import pytest
from jaxtyping import AbstractArray, jaxtyped

from openjax.vehicle import (
    DroneState,
    Vehicle,
    hover_state,
    load_vehicle,
    parameters,
    rate_controller,
    rigid_body,
    rotors,
    solids,
    stops,
)
from openjax.vehicle.arena import Arena

SIZES = {"drones": 3, "pillars": 2, "others": 2, "things": 5}
MODULES = (parameters, inspect.getmodule(rate_controller), rigid_body, rotors, solids, stops)


def is_array(kind):
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def example(kind, name):
    """Something of a type; drones are three where the argument's name says so."""
    if typing.get_origin(kind) is tuple:
        return tuple(example(part, name) for part in typing.get_args(kind))
    kinds = [kind, *typing.get_args(kind)]
    if arrays := [kind for kind in kinds if is_array(kind)]:
        shape = tuple(SIZES.get(size) or int(size) for size in arrays[0].dim_str.split())
        return jnp.full(shape, "bool" in arrays[0].dtypes or 0.5)
    if kind in (Vehicle, Arena):
        return load_vehicle() if kind is Vehicle else Arena()
    if kind is DroneState:
        return hover_state(load_vehicle(), jnp.eye(3) if name == "drones" else jnp.ones(3))
    if dataclasses.is_dataclass(kind):
        return kind(
            **{name: example(field, name) for name, field in typing.get_type_hints(kind).items()}
        )
    return None


def check(value, kind):
    if typing.get_origin(kind) is tuple:
        for part, own in zip(value, typing.get_args(kind), strict=True):
            check(part, own)
    else:
        assert isinstance(value, kind), (kind, getattr(value, "shape", value))


def shaped_functions():
    for module in MODULES:
        for name, function in inspect.getmembers(module, inspect.isfunction):
            hints = typing.get_type_hints(function)
            own = function.__module__ == module.__name__ and not name.startswith("_")
            # no example can be made of what has no type, or of some things in a row
            own &= set(inspect.signature(function).parameters) <= set(hints)
            own &= Sequence not in {typing.get_origin(hint) for hint in hints.values()}
            if own and any(
                is_array(kind) for hint in hints.values() for kind in (hint, *typing.get_args(hint))
            ):
                yield pytest.param(function, hints, id=name)


@pytest.mark.parametrize(("function", "hints"), shaped_functions())
def test_results_are_of_their_types(function, hints):
    with jaxtyped("context"):
        given = {name: example(kind, name) for name, kind in hints.items() if name != "return"}
        for name, kind in hints.items():
            if name != "return" and is_array(kind):
                check(given[name], kind)
        check(function(**given), hints["return"])
