"""A traced JAX function, walked operation by operation: what the exports to other languages have in common."""

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
        """Of its first result."""
        return tuple(self.equation.outvars[0].aval.shape)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Of its inputs."""
        return [tuple(atom.aval.shape) for atom in self.equation.invars]


class Walk:
    """Goes through a jaxpr. What doesn't depend on its inputs is computed; each operation left is a call of `node`.

    A value is a NumPy array, or whatever `node` makes and `inputs` give. By default `node` is the method that is named after
    the primitive: `_op_transpose` and so on, or `_op_elementwise` for the primitives in `elementwise`.
    """

    language = ""
    elementwise: frozenset[str] = frozenset()

    def node(self, operation: Operation):
        """The output of an operation, or a list of its outputs. Raises UserError where it has no counterpart."""
        name = "elementwise" if operation.name in self.elementwise else operation.name
        rule = getattr(self, f"_op_{name}", None)
        if rule is None:
            raise UserError(
                f"the policy uses the operation {operation.name!r}, which has no counterpart in the {self.language} export yet"
            )
        return rule(operation)

    def reshape(self, value, shape: tuple[int, ...]):
        """A value in another shape."""
        raise NotImplementedError

    def join(self, values: list, shape: tuple[int, ...], axis: int):
        """Values one after the other along an axis, which together have this shape."""
        raise NotImplementedError

    def power(self, value, exponent: int, operation: Operation):
        """A value to a whole power."""
        raise NotImplementedError

    def _op_reshape(self, operation: Operation):
        return self.reshape(operation.inputs[0], operation.shape)

    _op_squeeze = _op_expand_dims = _op_reshape

    def _op_concatenate(self, operation: Operation):
        return self.join(operation.inputs, operation.shape, operation.parameters["dimension"])

    def _op_stack(self, operation: Operation):
        shape, axis = operation.shape, operation.parameters["axis"]
        apart = (*shape[:axis], 1, *shape[axis + 1 :])
        return self.join([self.reshape(value, apart) for value in operation.inputs], shape, axis)

    def _op_integer_pow(self, operation: Operation):
        return self.power(operation.inputs[0], operation.parameters["y"], operation)

    def _op_square(self, operation: Operation):
        return self.power(operation.inputs[0], 2, operation)

    def run(self, jaxpr, consts, inputs) -> list:
        """The outputs of a jaxpr for input values."""
        values = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        values |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(atom):
            return np.asarray(atom.val) if hasattr(atom, "val") else values[atom]

        for equation in jaxpr.eqns:
            found = self._equation(equation, [read(atom) for atom in equation.invars])
            values |= dict(zip(equation.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation, inputs) -> list:
        name, parameters = equation.primitive.name, equation.params
        if name == "platform_index":  # what is not for a platform of its own comes last
            return [np.int32(len(parameters["platforms"]) - 1)]
        if name == "cond" and isinstance(inputs[0], np.ndarray | np.generic):
            branch = parameters["branches"][int(inputs[0])]
            return self.run(branch.jaxpr, branch.consts, inputs[1:])
        if name in _INLINE:
            inner = next(parameters[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in parameters)
            consts = getattr(inner, "consts", ())
            return self.run(getattr(inner, "jaxpr", inner), consts, inputs)
        if all(isinstance(value, np.ndarray | np.generic) for value in inputs):
            found = equation.primitive.bind(*inputs, **parameters)
            found = found if equation.primitive.multiple_results else [found]
            return [np.asarray(value) for value in found]
        found = self.node(Operation(name, parameters, inputs, equation))
        return found if isinstance(found, list) else [found]


def outer_padding(operation: Operation) -> tuple[list[int], list[int]]:
    """What a `pad` adds before and after each axis. Raises UserError where it adds between entries, or takes away."""
    low, high, between = zip(*operation.parameters["padding_config"], strict=True)
    if any(between) or min(*low, *high, 0) < 0:
        raise UserError("the policy pads between entries or cuts, which no export knows yet")
    return list(low), list(high)


def trace(function: Callable, inputs: dict[str, jax.ShapeDtypeStruct]):
    """The closed jaxpr of `function(**inputs)`, its inputs in the order of `inputs`."""
    names = list(inputs)
    return jax.make_jaxpr(lambda *values: function(**dict(zip(names, values, strict=True))))(*inputs.values())
