"""A JAX function as a plain ONNX graph, built node by node with `onnx.helper`.

The function is traced, what doesn't depend on its inputs is computed, and each
operation left becomes its ONNX counterpart. So it follows the networks wherever they
go, as long as they keep to the operations below.
"""

import math
from collections.abc import Callable, Sequence

import jax
import numpy as np

from openjax.errors import UserError
from openjax.export.traced import Walk, outer_padding, trace

# the first whose reductions all take their axes as an input
OPSET = 18
_ELEMENTWISE = {
    "add": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "div": "Div",
    "max": "Max",
    "min": "Min",
    "tanh": "Tanh",
    "exp": "Exp",
    "log": "Log",
    "logistic": "Sigmoid",
    "neg": "Neg",
    "abs": "Abs",
    "sqrt": "Sqrt",
    "sin": "Sin",
    "cos": "Cos",
    "erf": "Erf",
    "floor": "Floor",
    "sign": "Sign",
    "pow": "Pow",
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
    "and": "And",
    "or": "Or",
    "not": "Not",
    "stop_gradient": "Identity",
    "copy": "Identity",
    "copy_p": "Identity",
    "optimization_barrier": "Identity",
}
_REDUCE = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax", "reduce_min": "ReduceMin"}


class _Graph(Walk):
    """Nodes and constants of a graph under construction. A value is a NumPy array or
    the name of a tensor.
    """

    language = "ONNX"
    elementwise = frozenset(_ELEMENTWISE)

    def __init__(self):
        from onnx import helper, numpy_helper

        self.helper = helper
        self.numpy_helper = numpy_helper
        self.nodes = []
        self.initializers = []
        self._count = 0

    def name(self, value) -> str:
        """The tensor of a value; a constant becomes an initializer."""
        if isinstance(value, str):
            return value
        self._count += 1
        name = f"c{self._count}"
        self.initializers.append(self.numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def add(self, kind: str, inputs: Sequence, outputs: int = 1, **attributes):
        """The output of a new node, or all of them."""
        self._count += 1
        names = [f"t{self._count}_{i}" for i in range(outputs)]
        inputs = [self.name(value) for value in inputs]
        self.nodes.append(self.helper.make_node(kind, inputs, names, **attributes))
        return names[0] if outputs == 1 else names

    def _reshape(self, value, shape):
        return self.add("Reshape", [value, _whole(shape)])

    def _transpose(self, value, order):
        return self.add("Transpose", [value], perm=list(order))

    def _product(self, first, second, shape):
        return self.add("MatMul", [first, second])

    def _join(self, values, shape, axis):
        return self.add("Concat", values, axis=axis)

    def _power(self, value, exponent, operation):
        if exponent == 2:
            return self.add("Mul", [value, value])
        dtype = operation.equation.invars[0].aval.dtype
        return self.add("Pow", [value, np.array(exponent, dtype)])

    def _op_elementwise(self, operation):
        return self.add(_ELEMENTWISE[operation.name], operation.inputs)

    def _op_ne(self, operation):
        return self.add("Not", [self.add("Equal", operation.inputs)])

    def _op_rsqrt(self, operation):
        return self.add("Reciprocal", [self.add("Sqrt", operation.inputs)])

    def _op_select_n(self, operation):
        # JAX names what stands for False first, ONNX what stands for True
        condition, if_false, if_true = operation.inputs
        return self.add("Where", [condition, if_true, if_false])

    def _op_clamp(self, operation):
        low, value, high = operation.inputs
        # ONNX's Clip takes bounds of one number only
        return self.add("Min", [self.add("Max", [low, value]), high])

    def _op_convert_element_type(self, operation):
        kind = self.helper.np_dtype_to_tensor_dtype(np.dtype(operation.parameters["new_dtype"]))
        return self.add("Cast", operation.inputs, to=kind)

    def _op_broadcast_in_dim(self, operation):
        # ONNX lines axes up from the last one, JAX says which goes where
        ones = [1] * len(operation.shape)
        axes = operation.parameters["broadcast_dimensions"]
        for axis, size in zip(axes, operation.shapes[0], strict=True):
            ones[axis] = size
        value = self._reshape(operation.inputs[0], ones)
        if tuple(ones) == operation.shape:
            return value
        return self.add("Expand", [value, _whole(operation.shape)])

    def _op_split(self, operation):
        sizes = operation.parameters["sizes"]
        axis = operation.parameters["axis"]
        inputs = [operation.inputs[0], _whole(sizes)]
        return self.add("Split", inputs, outputs=len(sizes), axis=axis)

    def _op_slice(self, operation):
        starts = operation.parameters["start_indices"]
        ends = operation.parameters["limit_indices"]
        axes = range(len(starts))
        strides = operation.parameters["strides"] or [1] * len(starts)
        bounds = [_whole(numbers) for numbers in (starts, ends, axes, strides)]
        return self.add("Slice", [operation.inputs[0], *bounds])

    def _op_pad(self, operation):
        value, filling = operation.inputs
        low, high = outer_padding(operation)
        return self.add("Pad", [value, _whole([*low, *high]), filling])

    def _op_reduce_sum(self, operation):
        axes = _whole(operation.parameters["axes"])
        return self.add(_REDUCE[operation.name], [operation.inputs[0], axes], keepdims=0)

    _op_reduce_max = _op_reduce_min = _op_reduce_sum


def _whole(numbers):
    return np.array(list(numbers), np.int64)


def onnx_model(function: Callable, inputs: dict[str, jax.ShapeDtypeStruct], output: str):
    """An ONNX model of `function(**inputs)`, which returns one array; inputs that it
    doesn't read are left out.

    Raises:
      UserError: onnx isn't installed, or the function uses an operation that isn't
      covered.
    """
    try:
        from onnx import TensorProto, checker, helper
    except ImportError as error:
        raise UserError("onnx is missing: pip install onnx onnxruntime") from error
    program = trace(function, inputs)
    graph = _Graph()
    (result,) = graph.run(program.jaxpr, program.consts, list(inputs))
    graph.nodes.append(helper.make_node("Identity", [graph.name(result)], [output]))
    names_read = {name for node in graph.nodes for name in node.input}

    def describe(name, kind):
        return helper.make_tensor_value_info(
            name, helper.np_dtype_to_tensor_dtype(kind.dtype), kind.shape
        )

    out = program.out_avals[0]
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "openjax_policy",
            [describe(name, kind) for name, kind in inputs.items() if name in names_read],
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
