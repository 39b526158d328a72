"""A traced JAX function, walked operation by operation: what the exports to other languages have in common."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

_INLINE = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
)


class Walk:
    """Goes through a jaxpr. What doesn't depend on its inputs is computed; each operation left is a call of `node`.

    A value is a NumPy array, or whatever `node` makes and `inputs` give.
    """

    def node(self, name: str, parameters: dict, inputs: list, equation):
        """The output of the primitive `name`, or a list of its outputs. At least one of `inputs` isn't an array."""
        raise NotImplementedError

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
        found = self.node(name, parameters, inputs, equation)
        return found if isinstance(found, list) else [found]


def trace(function: Callable, inputs: dict[str, jax.ShapeDtypeStruct]):
    """The closed jaxpr of `function(**inputs)`, its inputs in the order of `inputs`."""
    names = list(inputs)
    return jax.make_jaxpr(lambda *values: function(**dict(zip(names, values, strict=True))))(*inputs.values())
