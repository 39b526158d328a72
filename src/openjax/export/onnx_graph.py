"""A JAX function as a plain ONNX graph, built node by node with `onnx.helper`.

The function is traced, what doesn't depend on its inputs is computed, and each operation left becomes its ONNX
counterpart. So it follows the networks wherever they go, as long as they keep to the operations below.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import numpy as np

from openjax.errors import UserError
from openjax.export.traced import Walk, trace

OPSET = 18
_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_SAME = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "max": "Max", "min": "Min", "tanh": "Tanh", "exp": "Exp",
    "log": "Log", "logistic": "Sigmoid", "neg": "Neg", "abs": "Abs", "sqrt": "Sqrt", "sin": "Sin", "cos": "Cos",
    "erf": "Erf", "floor": "Floor", "sign": "Sign", "pow": "Pow", "lt": "Less", "le": "LessOrEqual", "gt": "Greater",
    "ge": "GreaterOrEqual", "eq": "Equal", "and": "And", "or": "Or", "not": "Not", "stop_gradient": "Identity",
    "copy": "Identity", "copy_p": "Identity", "optimization_barrier": "Identity",
}  # fmt: skip


class _Graph(Walk):
    """Nodes and constants of a graph under construction. A value is a NumPy array or the name of a tensor."""

    def __init__(self):
        from onnx import helper, numpy_helper

        self.helper, self.numpy_helper = helper, numpy_helper
        self.nodes, self.initializers, self._count = [], [], 0

    def name(self, value) -> str:
        """The tensor of a value; a constant becomes an initializer."""
        if isinstance(value, str):
            return value
        self._count += 1
        name = f"c{self._count}"
        self.initializers.append(self.numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def add(self, kind: str, *inputs, outputs: int = 1, **attributes):
        """The output of a new node, or all of them."""
        self._count += 1
        names = [f"t{self._count}_{i}" for i in range(outputs)]
        inputs = [self.name(value) for value in inputs]
        self.nodes.append(self.helper.make_node(kind, inputs, names, **attributes))
        return names[0] if outputs == 1 else names

    def reshape(self, value, shape):
        return self.add("Reshape", value, np.array(shape, np.int64))

    def node(self, name, p, inputs, equation):
        shape = equation.outvars[0].aval.shape
        first = inputs[0]
        if name in _SAME:
            return self.add(_SAME[name], *inputs)
        if name == "ne":
            return self.add("Not", self.add("Equal", *inputs))
        if name == "square":
            return self.add("Mul", first, first)
        if name == "rsqrt":
            return self.add("Reciprocal", self.add("Sqrt", first))
        if name == "integer_pow":
            return self.add("Pow", first, np.array(p["y"], equation.invars[0].aval.dtype))
        if name == "select_n" and len(inputs) == 3:
            return self.add("Where", first, inputs[2], inputs[1])
        if name == "clamp":
            return self.add("Min", self.add("Max", inputs[1], first), inputs[2])
        if name == "convert_element_type":
            kind = self.helper.np_dtype_to_tensor_dtype(np.dtype(p["new_dtype"]))
            return self.add("Cast", first, to=kind)
        if name in ("reshape", "squeeze", "expand_dims"):
            return self.reshape(first, shape)
        if name == "broadcast_in_dim":
            ones = [1] * len(p["shape"])
            for axis, size in zip(p["broadcast_dimensions"], equation.invars[0].aval.shape, strict=True):
                ones[axis] = size
            value = self.reshape(first, ones)
            return (
                value if tuple(ones) == tuple(shape) else self.add("Expand", value, np.array(shape, np.int64))
            )
        if name == "transpose":
            return self.add("Transpose", first, perm=list(p["permutation"]))
        if name == "concatenate":
            return self.add("Concat", *inputs, axis=p["dimension"])
        if name == "stack":
            axis = p["axis"]
            apart = [*shape[:axis], 1, *shape[axis + 1 :]]
            return self.add("Concat", *(self.reshape(value, apart) for value in inputs), axis=axis)
        if name == "split":
            return self.add(
                "Split", first, np.array(p["sizes"], np.int64), outputs=len(p["sizes"]), axis=p["axis"]
            )
        if name == "slice":
            starts, limits = np.array(p["start_indices"], np.int64), np.array(p["limit_indices"], np.int64)
            strides = np.array(p["strides"] or [1] * len(starts), np.int64)
            return self.add("Slice", first, starts, limits, np.arange(len(starts), dtype=np.int64), strides)
        if name == "pad" and all(inner == 0 for _, _, inner in p["padding_config"]):
            low_high = [low for low, _, _ in p["padding_config"]] + [
                high for _, high, _ in p["padding_config"]
            ]
            return self.add("Pad", first, np.array(low_high, np.int64), inputs[1])
        if name in ("reduce_sum", "reduce_max", "reduce_min"):
            kind = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax", "reduce_min": "ReduceMin"}[name]
            return self.add(kind, first, np.array(p["axes"], np.int64), keepdims=0)
        if name == "dot_general":
            return self.add("Einsum", *inputs, equation=_einsum(equation, p["dimension_numbers"]))
        raise UserError(
            f"the policy uses the operation {name!r}, which has no counterpart in the ONNX export yet"
        )


def _einsum(equation, dimension_numbers) -> str:
    """A product of two arrays in Einstein's notation."""
    (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers
    letters = iter(_LETTERS)
    left = [next(letters) for _ in equation.invars[0].aval.shape]
    right = [""] * len(equation.invars[1].aval.shape)
    for a, b in (*zip(left_sum, right_sum, strict=True), *zip(left_batch, right_batch, strict=True)):
        right[b] = left[a]
    right = [letter or next(letters) for letter in right]
    out = [left[a] for a in left_batch]
    out += [letter for a, letter in enumerate(left) if a not in (*left_sum, *left_batch)]
    out += [letter for b, letter in enumerate(right) if b not in (*right_sum, *right_batch)]
    return f"{''.join(left)},{''.join(right)}->{''.join(out)}"


def onnx_model(function: Callable, inputs: dict[str, jax.ShapeDtypeStruct], output: str):
    """An ONNX model of `function(**inputs)`, which returns one array; inputs that it doesn't read are left out.

    Raises:
      UserError: onnx isn't installed, or the function uses an operation that isn't covered.
    """
    try:
        from onnx import TensorProto, checker, helper
    except ImportError as error:
        raise UserError("onnx is missing: pip install onnx onnxruntime") from error
    traced = trace(function, inputs)
    graph = _Graph()
    (result,) = graph.run(traced.jaxpr, traced.consts, list(inputs))
    graph.nodes.append(helper.make_node("Identity", [graph.name(result)], [output]))
    read = {name for node in graph.nodes for name in node.input}

    def described(name, kind):
        return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(kind.dtype), kind.shape)

    out = traced.out_avals[0]
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "openjax_policy",
            [described(name, kind) for name, kind in inputs.items() if name in read],
            [helper.make_tensor_value_info(output, TensorProto.FLOAT, out.shape)],
            graph.initializers,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=9,
        producer_name="openjax",
    )
    checker.check_model(model, full_check=True)
    return model


def size(model) -> int:
    """Numbers in a model's constants."""
    return sum(math.prod(tensor.dims) for tensor in model.graph.initializer)
