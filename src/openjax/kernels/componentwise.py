"""Evaluating a function of small arrays component by component.

A GPU kernel handles many drones side by side, but has no vectors of three for each of
them. So the function of one drone is traced, and its operations are done again on
arrays of objects whose every component is a block of drones: what only moves components
(slices, stacks, transposes) costs nothing, and the kernel needs no second set of
formulas.
"""

import functools
import operator
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call")
_REDUCTIONS = {"reduce_sum": operator.add, "reduce_or": operator.or_, "reduce_and": operator.and_}
_ELEMENTWISE = frozenset(
    "abs add and atan2 clamp convert_element_type copy cos div eq exp expm1 ge gt integer_pow le "
    "log lt max min mul ne "
    "neg not or pow rsqrt select_n sign sin sqrt square sub tanh".split()
)


def split(parts: Iterable) -> np.ndarray:
    """A one-dimensional array of objects with these components."""
    parts = list(parts)
    array = np.empty(len(parts), object)
    for i, part in enumerate(parts):
        array[i] = part
    return array


def _numbers(array):
    array = np.asarray(array)
    return split(array.ravel()).reshape(array.shape)


def evaluate(program: ClosedJaxpr, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The result of a traced function for `arguments`, arrays of objects of its inputs' shapes.

    A component is a number, a scalar or a block (all of one shape) of the input's type;
    so are the results'.

    Raises:
      NotImplementedError: the function holds an operation that mixes components in a
      way not known here.
    """
    return _evaluate(program.jaxpr, program.consts, arguments)


def _evaluate(jaxpr: Jaxpr, constants, arguments):
    values = dict(zip(jaxpr.invars, arguments, strict=True))
    values |= {
        variable: _numbers(constant)
        for variable, constant in zip(jaxpr.constvars, constants, strict=True)
    }

    def read(variable):
        if isinstance(variable, Literal):
            return _numbers(np.asarray(variable.val, variable.aval.dtype))
        return values[variable]

    for equation in jaxpr.eqns:
        results = _apply(equation, [read(variable) for variable in equation.invars])
        values |= zip(equation.outvars, results, strict=True)
    return [read(variable) for variable in jaxpr.outvars]


def _apply(equation, inputs):
    name = equation.primitive.name
    parameters = equation.params
    if name in _CALLS:
        inner = parameters["jaxpr"] if "jaxpr" in parameters else parameters["call_jaxpr"]
        return _evaluate(inner.jaxpr, inner.consts, inputs)
    if name in _ELEMENTWISE:
        return [_each(functools.partial(_bind, equation), inputs)]
    if name in _REDUCTIONS:
        return [_total(_REDUCTIONS[name], inputs[0], parameters["axes"])]
    if name == "stop_gradient":  # nothing is differentiated here
        return inputs
    if name == "reduce" and _is_sum(parameters["jaxpr"]):
        # several sums at once: the arrays first, then as many starts, which are zero
        arrays = inputs[: len(inputs) // 2]
        return [_total(operator.add, array, parameters["dimensions"]) for array in arrays]
    if name == "unstack":
        axis = parameters["axis"]
        array = inputs[0]
        return [np.squeeze(part, axis) for part in np.split(array, array.shape[axis], axis)]
    if name not in _MOVES:
        raise NotImplementedError(f"component by component: {name}")
    return [_MOVES[name](inputs, parameters)]


def _is_sum(combination):
    """True if all that a reduction combines with is addition."""
    return {equation.primitive.name for equation in combination.eqns} == {"add"}


def _slice(inputs, parameters):
    strides = parameters["strides"] or (1,) * inputs[0].ndim
    ranges = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return inputs[0][tuple(slice(start, stop, step) for start, stop, step in ranges)]


def _broadcast(inputs, parameters):
    shape = [1] * len(parameters["shape"])
    for axis, size in zip(parameters["broadcast_dimensions"], inputs[0].shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(inputs[0].reshape(shape), parameters["shape"])


_MOVES = {
    "slice": _slice,
    "broadcast_in_dim": _broadcast,
    "squeeze": lambda inputs, parameters: np.squeeze(inputs[0], tuple(parameters["dimensions"])),
    "reshape": lambda inputs, parameters: inputs[0].reshape(parameters["new_sizes"]),
    "transpose": lambda inputs, parameters: inputs[0].transpose(parameters["permutation"]),
    "concatenate": lambda inputs, parameters: np.concatenate(inputs, parameters["dimension"]),
    "stack": lambda inputs, parameters: np.stack(inputs, parameters["axis"]),
    "rev": lambda inputs, parameters: np.flip(inputs[0], parameters["dimensions"]),
}


def _each(function, arrays):
    """The function of the arrays' components one by one, in an array of their common
    shape.
    """
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    flat = (np.broadcast_to(array, shape).ravel() for array in arrays)
    return split(function(operands) for operands in zip(*flat, strict=True)).reshape(shape)


def _bind(equation, operands):
    """One operation on single components, which are made alike in shape."""
    if all(isinstance(operand, np.generic) for operand in operands):
        # of numbers alone: worked out here, or the kernel would work it out for every
        # sample
        with jax.ensure_compile_time_eval():
            return np.asarray(equation.primitive.bind(*operands, **equation.params))[()]
    shape = np.broadcast_shapes(*(np.shape(operand) for operand in operands))

    def of_shape(operand):
        if np.shape(operand) == shape and not isinstance(operand, np.generic):
            return operand
        return jnp.broadcast_to(operand, shape)

    return equation.primitive.bind(*map(of_shape, operands), **equation.params)


def _total(combine, array, axes):
    """The components combined along the axes: a row for each component that is left."""
    other_axes = [axis for axis in range(array.ndim) if axis not in axes]
    shape = [array.shape[axis] for axis in other_axes]
    rows = array.transpose(*other_axes, *axes).reshape(int(np.prod(shape)), -1)
    return split(functools.reduce(combine, row) for row in rows).reshape(shape)
