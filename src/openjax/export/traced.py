"""A traced JAX function, walked operation by operation: what the exports to other
languages have in common.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from openjax.errors import UserError

_INLINE = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
)


@dataclass(frozen=True)
class Operation:
    """One primitive of a jaxpr that depends on the program's inputs."""

    name: str
    parameters: dict
    inputs: list
    """Values of which at least one isn't an array."""
    equation: JaxprEqn

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of its first result."""
        return tuple(self.equation.outvars[0].aval.shape)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of its inputs."""
        return [tuple(atom.aval.shape) for atom in self.equation.invars]


class Walk:
    """Goes through a jaxpr. What doesn't depend on its inputs is computed; each
    operation left is a call of a method that is named after the primitive: `_op_pad`
    and so on, or `_op_elementwise` for the primitives in `elementwise`.

    A value is a NumPy array, or whatever those methods make and `inputs` give. A
    language says how it writes the parts of which the operations below are made:
    `_reshape(value, shape)`, `_transpose(value, order)`, `_join(values, shape, axis)`,
    `_power(value, exponent, operation)`, and `_product(first, second, shape)` of
    matrices, or of as many batches of them.
    """

    language = ""
    elementwise: frozenset[str] = frozenset()

    def _op_reshape(self, operation: Operation):
        return self._reshape(operation.inputs[0], operation.shape)

    _op_squeeze = _op_expand_dims = _op_reshape

    def _op_transpose(self, operation: Operation):
        return self._transpose(operation.inputs[0], operation.parameters["permutation"])

    def _op_concatenate(self, operation: Operation):
        return self._join(operation.inputs, operation.shape, operation.parameters["dimension"])

    def _op_stack(self, operation: Operation):
        shape = operation.shape
        axis = operation.parameters["axis"]
        part_shape = (*shape[:axis], 1, *shape[axis + 1 :])
        return self._join(
            [self._reshape(value, part_shape) for value in operation.inputs], shape, axis
        )

    def _op_integer_pow(self, operation: Operation):
        return self._power(operation.inputs[0], operation.parameters["y"], operation)

    def _op_square(self, operation: Operation):
        return self._power(operation.inputs[0], 2, operation)

    def _op_dot_general(self, operation: Operation):
        sums, batches = operation.parameters["dimension_numbers"]
        sizes = []
        factors = []
        # each factor as matrices: axes of a kind are joined, and what is summed over
        # stands last on the left side, first on the right
        for side, (value, shape) in enumerate(zip(operation.inputs, operation.shapes, strict=True)):
            batch = batches[side]
            sum_axes = sums[side]
            free = [axis for axis in range(len(shape)) if axis not in (*batch, *sum_axes)]
            groups = (batch, sum_axes, free) if side else (batch, free, sum_axes)
            matrix = [math.prod(shape[axis] for axis in group) for group in groups]
            matrix = tuple(matrix if batch else matrix[1:])
            order = [axis for group in groups for axis in group]
            sizes.append(matrix)
            factors.append(self._as_matrices(value, shape, order, matrix))
        shape = (*sizes[0][:-1], sizes[1][-1])
        first, second = factors
        product = self._product(first, second, shape)
        return product if shape == operation.shape else self._reshape(product, operation.shape)

    def _as_matrices(self, value, shape, order, matrix):
        """A value with its axes in another order and joined to those of `matrix`; what
        is known is moved here, and not by the program.
        """
        if order != sorted(order):
            value = (
                np.transpose(value, order) if _is_known(value) else self._transpose(value, order)
            )
        if matrix != tuple(shape[axis] for axis in order):
            value = np.reshape(value, matrix) if _is_known(value) else self._reshape(value, matrix)
        return value

    def run(self, jaxpr, consts, inputs) -> list:
        """The outputs of a jaxpr for input values."""
        values = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        values |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(atom):
            return np.asarray(atom.val) if hasattr(atom, "val") else values[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation, inputs) -> list:
        name = equation.primitive.name
        parameters = equation.params
        if name == "platform_index":  # what is not for a platform of its own comes last
            return [np.int32(len(parameters["platforms"]) - 1)]
        if name == "cond" and _is_known(inputs[0]):
            branch = parameters["branches"][int(inputs[0])]
            return self.run(branch.jaxpr, branch.consts, inputs[1:])
        if name in _INLINE:
            inner = next(
                parameters[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in parameters
            )
            consts = getattr(inner, "consts", ())
            return self.run(getattr(inner, "jaxpr", inner), consts, inputs)
        if all(map(_is_known, inputs)):
            results = equation.primitive.bind(*inputs, **parameters)
            results = results if equation.primitive.multiple_results else [results]
            return [np.asarray(value) for value in results]
        rule = getattr(self, f"_op_{'elementwise' if name in self.elementwise else name}", None)
        # refused, and not left out: a policy that is nearly right is worse than none
        if rule is None:
            raise UserError(
                f"the policy uses the operation {name!r}, which has no counterpart in the "
                f"{self.language} export yet"
            )
        results = rule(Operation(name, parameters, inputs, equation))
        return results if isinstance(results, list) else [results]


def _is_known(value) -> bool:
    """True if a value is known here already."""
    return isinstance(value, np.ndarray | np.generic)


def outer_padding(operation: Operation) -> tuple[list[int], list[int]]:
    """The padding that a `pad` adds before and after each axis. Raises UserError if it adds between
    entries, or takes away.
    """
    low, high, between = zip(*operation.parameters["padding_config"], strict=True)
    if any(between) or min(*low, *high, 0) < 0:
        raise UserError("the policy pads between entries or cuts, which no export supports yet")
    return list(low), list(high)


def trace(function: Callable, inputs: dict[str, jax.ShapeDtypeStruct]):
    """The closed jaxpr of `function(**inputs)`, its inputs in the order of `inputs`."""

    def of_values(*values):
        return function(**dict(zip(inputs, values, strict=True)))

    return jax.make_jaxpr(of_values)(*inputs.values())
