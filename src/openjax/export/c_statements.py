"""Statements of a C program, written operation by operation: what `openjax.export.c_program` puts into a file.

Products of matrices become calls of one function; chains of operations element by element become one loop nest; views
(slices, transposes, broadcasts) become index arithmetic.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from openjax.errors import UserError
from openjax.export.c_text import BINARY, UNARY, index_names, literal, loops, offset_by
from openjax.export.traced import Walk, outer_padding

_SAME = ("stop_gradient", "copy", "copy_p", "optimization_barrier", "convert_element_type")
_REDUCE = {
    "reduce_sum": ("0.0f", "{} + {}"),
    "reduce_max": ("-INFINITY", "fmaxf({}, {})"),
    "reduce_min": ("INFINITY", "fminf({}, {})"),
}


@dataclass(frozen=True)
class Value:
    """An array as it is read: a dense one, a view of one, or a computation that isn't done yet."""

    shape: tuple[int, ...]
    at: Callable[[Sequence[str]], str]
    """Indices to the expression of an element."""
    reads: frozenset[int]
    """Buffers that the expression reads."""
    dense: str | None = None
    """The C name of a dense array that holds it."""
    computes: bool = False
    """Whether an element costs more than to read it."""


@dataclass
class Buffer:
    """Floats of the workspace, and the statements between which they hold something."""

    size: int
    written: int
    read: int
    offset: int = 0


class _Token:
    """A value of which only its readers are counted."""

    def __init__(self):
        self.readers = 0


class Readers(Walk):
    """Counts the readers of each operation's result, in the order of the operations."""

    def __init__(self):
        self.found: list[list[_Token]] = []

    def node(self, operation):
        """See `Walk`."""
        if operation.name in _SAME:
            self.found.append([])
            return operation.inputs[0]
        for value in operation.inputs:
            if isinstance(value, _Token):
                value.readers += 1
        self.found.append([_Token() for _ in operation.equation.outvars])
        return self.found[-1]

    def count(self, traced, number: int) -> list[int]:
        """The most readers of any result of each operation."""
        for result in self.run(traced.jaxpr, traced.consts, [_Token() for _ in range(number)]):
            result.readers += 1
        return [max((token.readers for token in tokens), default=0) for tokens in self.found]


class Writer(Walk):
    """Statements and constants of a program under construction.

    Args:
      readers: how often the result of each operation is read.
    """

    language = "C"
    elementwise = frozenset((*BINARY, *UNARY))

    def __init__(self, readers: list[int]):
        self._readers, self._operation = readers, -1
        self.statements: list[str] = []
        self.buffers: list[Buffer] = []
        self.constants: list[np.ndarray] = []
        self.multiply_adds, self.functions = 0, 0
        self._names: dict[bytes, int] = {}

    # -- values

    def constant(self, value) -> Value:
        """A known array; single numbers are written where they are used."""
        value = np.asarray(value, np.float32)
        whole, same = value.shape, []
        for axis in range(value.ndim):  # copies of a row aren't written out
            one = value.take([0], axis)
            if value.shape[axis] > 1 and np.array_equal(np.broadcast_to(one, value.shape), value):
                value = one
                same.append(axis)
        if value.size == 1:
            number = literal(value.item())
            return Value(whole, lambda _: number, frozenset())
        key = np.ascontiguousarray(value).tobytes()
        if key not in self._names:
            self._names[key] = len(self.constants)
            self.constants.append(np.ascontiguousarray(value).reshape(-1))
        array = dense_array(f"c{self._names[key]}", value.shape)
        if not same:
            return array
        return Value(
            whole, lambda at: array.at(["0" if a in same else i for a, i in enumerate(at)]), array.reads
        )

    def value(self, value) -> Value:
        """A value as it is read."""
        return value if isinstance(value, Value) else self.constant(value)

    def emit(self, text: str, writes: int, reads: frozenset[int]) -> None:
        """Append a statement that writes one buffer and reads others."""
        now = len(self.statements)
        for buffer in reads:
            self.buffers[buffer].read = now
        self.buffers[writes].read = max(self.buffers[writes].read, now)
        self.statements.append(text)

    def buffer(self, shape) -> tuple[int, Value]:
        """A new array in the workspace."""
        now = len(self.statements)
        self.buffers.append(Buffer(math.prod(shape), now, now))
        number = len(self.buffers) - 1
        return number, dense_array(f"t{number}", shape, frozenset([number]))

    def stored(self, value: Value) -> Value:
        """The value as a dense array."""
        if value.dense is not None:
            return value
        number, stored = self.buffer(value.shape)
        indices = index_names(value.shape)
        body = f"{stored.at(indices)} = {value.at(indices)};"
        self.emit(loops(value.shape, indices, body), number, value.reads)
        return stored

    # -- operations

    def node(self, operation):
        """See `Walk`."""
        self._operation += 1
        return super().node(operation)

    def _op_stop_gradient(self, operation):
        before, after = (
            v.aval.dtype.kind for v in (operation.equation.invars[0], operation.equation.outvars[0])
        )
        if after == "b" != before:
            raise UserError("the policy turns numbers into flags, which the C export doesn't know yet")
        return operation.inputs[0]

    _op_copy = _op_copy_p = _op_optimization_barrier = _op_convert_element_type = _op_stop_gradient

    def _op_elementwise(self, operation):
        name, shape = operation.name, operation.shape
        self.functions += math.prod(shape) * (name in UNARY and name not in ("neg", "abs", "not", "floor"))
        return self._elementwise({**BINARY, **UNARY}[name], operation.inputs, shape)

    def _op_select_n(self, operation):
        return self._elementwise("({0} != 0.0f ? {2} : {1})", operation.inputs, operation.shape)

    def _op_clamp(self, operation):
        return self._elementwise("fminf(fmaxf({1}, {0}), {2})", operation.inputs, operation.shape)

    def _op_transpose(self, operation):
        order = operation.parameters["permutation"]
        back = [order.index(axis) for axis in range(len(order))]
        return self._view(operation.inputs[0], operation.shape, lambda at: [at[axis] for axis in back])

    def _op_slice(self, operation):
        starts = operation.parameters["start_indices"]
        steps = operation.parameters["strides"] or [1] * len(starts)
        return self._view(
            operation.inputs[0],
            operation.shape,
            lambda at: [offset_by(i, k, s) for i, k, s in zip(at, starts, steps, strict=True)],
        )

    def _elementwise(self, form, values, shape):
        values = [self.value(v) for v in values]
        # an axis of length one is repeated; what costs anything is computed once, not for each repetition
        repeated = [math.prod(v.shape) < math.prod(shape) for v in values]
        values = [self.stored(v) if v.computes and r else v for v, r in zip(values, repeated, strict=True)]

        def element(value, indices):
            return value.at(["0" if n == 1 else i for i, n in zip(indices, value.shape, strict=False)])

        def at(indices):
            return form.format(*(element(v, indices) for v in values))

        value = Value(shape, at, frozenset().union(*(v.reads for v in values)), computes=True)
        # what only one operation reads is computed there
        return self.stored(value) if self._readers[self._operation] > 1 else value

    def power(self, base, exponent, operation):
        """See `Walk`."""
        base = self.stored(base) if base.computes else base
        factors = " * ".join(["{0}"] * abs(exponent)) or "1.0f"
        form = f"({factors})" if exponent >= 0 else f"(1.0f / ({factors}))"
        return self._elementwise(form, [base], operation.shape)

    def _view(self, value, shape, back):
        if value.computes and self._readers[self._operation] > 1:
            value = self.stored(value)
        return Value(shape, lambda indices: value.at(back(indices)), value.reads, computes=value.computes)

    def _op_broadcast_in_dim(self, operation):
        value, shape, axes = (
            operation.inputs[0],
            operation.shape,
            operation.parameters["broadcast_dimensions"],
        )
        if value.computes and math.prod(shape) > math.prod(value.shape):  # computed once, not for each copy
            value = self.stored(value)
        kept = [(axis, size) for axis, size in zip(axes, value.shape, strict=True)]
        return self._view(value, shape, lambda at: ["0" if size == 1 else at[axis] for axis, size in kept])

    def reshape(self, value, shape):
        """See `Walk`."""
        value = self.value(value)
        if value.dense is not None:
            return dense_array(value.dense, shape, value.reads)
        if [n for n in value.shape if n > 1] == [n for n in shape if n > 1]:  # only axes of length one

            def back(at):
                left = iter(i for i, n in zip(at, shape, strict=True) if n > 1)
                return ["0" if n == 1 else next(left) for n in value.shape]

            return self._view(value, shape, back)
        return self.reshape(self.stored(value), shape)

    def _op_split(self, operation):
        value, axis, start, parts = operation.inputs[0], operation.parameters["axis"], 0, []
        for size in operation.parameters["sizes"]:
            shape = (*value.shape[:axis], size, *value.shape[axis + 1 :])
            parts.append(
                self._view(
                    value,
                    shape,
                    lambda at, start=start: [
                        offset_by(i, start if a == axis else 0, 1) for a, i in enumerate(at)
                    ],
                )
            )
            start += size
        return parts

    def join(self, values, shape, axis):
        """See `Walk`."""
        number, joined = self.buffer(shape)
        start = 0
        for value in map(self.value, values):
            indices = index_names(value.shape)
            there = [offset_by(i, start if a == axis else 0, 1) for a, i in enumerate(indices)]
            body = f"{joined.at(there)} = {value.at(indices)};"
            self.emit(loops(value.shape, indices, body), number, value.reads)
            start += value.shape[axis]
        return joined

    def _op_pad(self, operation):
        (value, filling), shape = map(self.value, operation.inputs), operation.shape
        low, _ = outer_padding(operation)
        number, padded = self.buffer(shape)
        indices = index_names(shape)
        body = f"{padded.at(indices)} = {filling.at(())};"
        self.emit(loops(shape, indices, body), number, filling.reads)
        indices = index_names(value.shape)
        there = [offset_by(i, start, 1) for i, start in zip(indices, low, strict=True)]
        body = f"{padded.at(there)} = {value.at(indices)};"
        self.emit(loops(value.shape, indices, body), number, value.reads)
        return padded

    def _op_reduce_sum(self, operation):
        value, shape, axes = operation.inputs[0], operation.shape, operation.parameters["axes"]
        start, form = _REDUCE[operation.name]
        number, reduced = self.buffer(shape)
        every = index_names(value.shape)
        outer = [i for a, i in enumerate(every) if a not in axes]
        inner = [i for a, i in enumerate(every) if a in axes]
        body = f"sum = {form.format('sum', value.at(every))};"
        body = (
            f"float sum = {start};\n{loops([value.shape[a] for a in axes], inner, body)}\n"
            f"{reduced.at(outer)} = sum;"
        )
        self.emit(loops(shape, outer, body), number, value.reads)
        return reduced

    _op_reduce_max = _op_reduce_min = _op_reduce_sum

    def _op_dot_general(self, operation):
        (left_sum, right_sum), (left_batch, right_batch) = operation.parameters["dimension_numbers"]
        inputs, shapes = operation.inputs, operation.shapes
        left_free = [a for a in range(len(shapes[0])) if a not in (*left_sum, *left_batch)]
        right_free = [a for a in range(len(shapes[1])) if a not in (*right_sum, *right_batch)]
        left = self._ordered(inputs[0], shapes[0], (*left_batch, *left_free, *left_sum))
        right = self._ordered(inputs[1], shapes[1], (*right_batch, *right_sum, *right_free))
        batch = math.prod(shapes[0][a] for a in left_batch)
        rows = math.prod(shapes[0][a] for a in left_free)
        inner = math.prod(shapes[0][a] for a in left_sum)
        columns = math.prod(shapes[1][a] for a in right_free)
        number, out = self.buffer(operation.shape)
        for k in range(batch):
            call = (
                f"product({left.dense} + {k * rows * inner}, {right.dense} + {k * inner * columns}, "
                f"{out.dense} + {k * rows * columns}, {rows}, {inner}, {columns});"
            )
            self.emit(call.replace(" + 0,", ","), number, left.reads | right.reads)
        self.multiply_adds += batch * rows * inner * columns
        return out

    def _ordered(self, value, shape, order):
        """A factor as a dense array with its axes in `order`."""
        if not isinstance(value, Value):
            return self._named(self.constant(np.transpose(np.asarray(value), order)))
        if list(order) == sorted(order):
            return self.stored(value)
        back = [order.index(axis) for axis in range(len(order))]
        moved = tuple(shape[axis] for axis in order)
        return self.stored(self._view(value, moved, lambda at: [at[axis] for axis in back]))

    def _named(self, value):
        return value if value.dense is not None else self.stored(value)


def dense_array(name, shape, reads=frozenset()) -> Value:
    """The value of an array of that name."""
    shape = tuple(shape)
    strides = [math.prod(shape[a + 1 :]) for a in range(len(shape))]

    def at(indices):
        terms = [
            i if s == 1 else f"{i} * {s}" for i, s in zip(indices, strides, strict=True) if str(i) != "0"
        ]
        return f"{name}[{' + '.join(terms) or '0'}]"

    return Value(shape, at, reads, dense=name)
