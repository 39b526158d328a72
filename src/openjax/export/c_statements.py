"""Statements of a C program, written operation by operation: what
`openjax.export.c_program` puts into a file.

Products of matrices become calls of one function, other operations a loop nest each.
Transposes, slices and broadcasts are arrays with other strides, as in NumPy, and cost
nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from openjax.errors import UserError
from openjax.export.c_text import ELEMENTWISE, FUNCTIONS, index_names, literal, loops
from openjax.export.traced import Walk, outer_padding

_REDUCE = {
    "reduce_sum": ("0.0f", "{} + {}"),
    "reduce_max": ("-INFINITY", "fmaxf({}, {})"),
    "reduce_min": ("INFINITY", "fminf({}, {})"),
}


@dataclass
class Buffer:
    """Floats of the workspace, and the statements between which they hold something."""

    size: int
    first_write: int
    read: int
    offset: int = 0


@dataclass(frozen=True)
class Array:
    """An array of the program, or a part of one: entry (i, j) is name[offset + i *
    strides[0] + j * strides[1]], and so on.
    """

    name: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int = 0
    buffer: Buffer | None = None
    """Its place in the workspace; None for inputs, results and constants."""
    number: str = ""
    """The value of all entries, where it is known and the same."""

    @property
    def dense(self) -> bool:
        """True if its entries follow one another row by row."""
        axes = zip(self.shape, self.strides, row_by_row(self.shape), strict=True)
        return not self.number and all(
            size == 1 or stride == dense_stride for size, stride, dense_stride in axes
        )

    @property
    def start(self) -> str:
        """A pointer to its first entry."""
        return f"{self.name} + {self.offset}" if self.offset else self.name

    def at(self, indices: Sequence[str]) -> str:
        """The expression of an entry; a single number's is the same for all indices."""
        if self.number:
            return self.number
        terms = [str(self.offset)] * (self.offset > 0)
        for index, size, stride in zip(indices, self.shape, self.strides, strict=False):
            # an axis of length one is repeated
            if index != "0" and size > 1 and stride:
                terms.append(index if stride == 1 else f"{index} * {stride}")
        return f"{self.name}[{' + '.join(terms) or '0'}]"

    def part(
        self, starts: Sequence[int], shape: Sequence[int], steps: Sequence[int] | None = None
    ) -> "Array":
        """Entries from `starts` on, every `steps`-th of each axis."""
        steps = steps or [1] * len(shape)
        offset_of_part = sum(
            start * stride for start, stride in zip(starts, self.strides, strict=True)
        )
        strides = tuple(step * stride for step, stride in zip(steps, self.strides, strict=True))
        offset = int(self.offset + offset_of_part)
        return replace(self, shape=tuple(shape), strides=strides, offset=offset)


def row_by_row(shape: Sequence[int]) -> tuple[int, ...]:
    """The strides of a dense array."""
    return tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


def dense_array(name: str, shape: Sequence[int], buffer: Buffer | None = None) -> Array:
    """A whole array of the program."""
    return Array(name, tuple(shape), row_by_row(shape), buffer=buffer)


class Writer(Walk):
    """Statements and constants of a program under construction."""

    language = "C"
    elementwise = frozenset(ELEMENTWISE)

    def __init__(self):
        self.statements: list[str] = []
        self.buffers: list[Buffer] = []
        self.constants: list[np.ndarray] = []
        self.multiply_adds = 0
        self.functions = 0
        self._names: dict[bytes, int] = {}

    # -- arrays

    def array(self, value) -> Array:
        """A value as it is read; one number is written where it is used, rows that are
        alike are kept once.
        """
        if isinstance(value, Array):
            return value
        value = np.asarray(value, np.float32)
        shape = value.shape
        strides = list(row_by_row(value.shape))
        for axis in range(value.ndim):
            one = value.take([0], axis)
            if value.shape[axis] > 1 and np.array_equal(np.broadcast_to(one, value.shape), value):
                value = one
                # outer axes are that much closer together now
                strides = [s // shape[axis] if a < axis else s for a, s in enumerate(strides)]
                strides[axis] = 0
        if value.size == 1:
            return Array("", shape, tuple(strides), number=literal(value.item()))
        values = np.ascontiguousarray(value).reshape(-1)
        key = values.tobytes()
        if key not in self._names:
            self._names[key] = len(self.constants)
            self.constants.append(values)
        return Array(f"c{self._names[key]}", shape, tuple(strides))

    def new(self, shape: Sequence[int]) -> Array:
        """An array in the workspace."""
        statement = len(self.statements)
        self.buffers.append(Buffer(math.prod(shape), statement, statement))
        return dense_array(f"t{len(self.buffers) - 1}", shape, self.buffers[-1])

    def emit(self, text: str, arrays: Sequence[Array]) -> None:
        """Append a statement that reads or writes these."""
        for array in arrays:
            if array.buffer is not None:
                array.buffer.read = len(self.statements)
        self.statements.append(text)

    def write(self, out: Array, form: str, values: Sequence[Array]) -> Array:
        """Write every entry of an array, which is the form of those of `values`."""
        arrays = [out, *values]
        if all(array.number or (array.dense and array.shape == out.shape) for array in arrays):
            # entry by entry in the order of memory: one loop does for all axes
            flat_shape = (math.prod(out.shape),)
            arrays = [replace(array, shape=flat_shape, strides=(1,)) for array in arrays]
        indices = index_names(arrays[0].shape)
        target, *operands = (array.at(indices) for array in arrays)
        body = f"{target} = {form.format(*operands)};"
        self.emit(loops(arrays[0].shape, indices, body), arrays)
        return arrays[0]

    def dense_copy(self, value: Array) -> Array:
        """The same as a dense array."""
        return value if value.dense else self._elementwise("{}", [value], value.shape)

    def _elementwise(self, form, values, shape):
        out = self.new(shape)
        self.write(out, form, [self.array(value) for value in values])
        return out

    # -- operations

    def _op_stop_gradient(self, operation):
        source = operation.equation.invars[0].aval.dtype.kind
        target = operation.equation.outvars[0].aval.dtype.kind
        # all of C's values are floats: flags are 0 and 1, and other numbers would stay
        # as they are
        if target == "b" and source != "b":
            raise UserError(
                "the policy turns numbers into flags, which the C export doesn't support yet"
            )
        return operation.inputs[0]

    _op_copy = _op_copy_p = _op_optimization_barrier = _op_convert_element_type = _op_stop_gradient

    def _op_elementwise(self, operation):
        self.functions += math.prod(operation.shape) * (operation.name in FUNCTIONS)
        return self._elementwise(ELEMENTWISE[operation.name], operation.inputs, operation.shape)

    def _power(self, value, exponent, operation):
        factors = " * ".join(["{0}"] * abs(exponent)) or "1.0f"
        form = f"({factors})" if exponent >= 0 else f"(1.0f / ({factors}))"
        return self._elementwise(form, [value], operation.shape)

    def _transpose(self, value, order):
        shape = tuple(value.shape[axis] for axis in order)
        strides = tuple(value.strides[axis] for axis in order)
        return replace(value, shape=shape, strides=strides)

    def _op_slice(self, operation):
        starts = operation.parameters["start_indices"]
        steps = operation.parameters["strides"]
        return operation.inputs[0].part(starts, operation.shape, steps)

    def _op_broadcast_in_dim(self, operation):
        value = operation.inputs[0]
        strides = [0] * len(operation.shape)
        axes = operation.parameters["broadcast_dimensions"]
        for axis, size, stride in zip(axes, value.shape, value.strides, strict=True):
            strides[axis] = stride if size > 1 else 0
        return replace(value, shape=operation.shape, strides=tuple(strides))

    def _reshape(self, value, shape):
        value = self.array(value)
        if [size for size in value.shape if size > 1] == [size for size in shape if size > 1]:
            # only axes of length one come or go: the others keep their strides
            dimensions = zip(value.strides, value.shape, strict=True)
            strides = iter([stride for stride, size in dimensions if size > 1])
            new_strides = tuple(next(strides) if size > 1 else 0 for size in shape)
            return replace(value, shape=shape, strides=new_strides)
        return replace(self.dense_copy(value), shape=shape, strides=row_by_row(shape))

    def _op_split(self, operation):
        value = operation.inputs[0]
        axis = operation.parameters["axis"]
        start = 0
        parts = []
        for size in operation.parameters["sizes"]:
            starts, shape = _within(value.shape, axis, start, size)
            parts.append(value.part(starts, shape))
            start += size
        return parts

    def _join(self, values, shape, axis):
        output = self.new(shape)
        start = 0
        for value in map(self.array, values):
            size = value.shape[axis]
            starts, part_shape = _within(shape, axis, start, size)
            self.write(output.part(starts, part_shape), "{}", [value])
            start += size
        return output

    def _op_pad(self, operation):
        value, filling = map(self.array, operation.inputs)
        result = self.new(operation.shape)
        self.write(result, "{}", [filling])
        low, _ = outer_padding(operation)
        self.write(result.part(low, value.shape), "{}", [value])
        return result

    def _op_reduce_sum(self, operation):
        value = operation.inputs[0]
        shape = operation.shape
        axes = operation.parameters["axes"]
        start, form = _REDUCE[operation.name]
        result = self.new(shape)
        every = index_names(value.shape)
        outer = [index for axis, index in enumerate(every) if axis not in axes]
        inner = [index for axis, index in enumerate(every) if axis in axes]
        add = f"sum = {form.format('sum', value.at(every))};"
        adding = loops([value.shape[axis] for axis in axes], inner, add)
        body = f"float sum = {start};\n{adding}\n{result.at(outer)} = sum;"
        self.emit(loops(shape, outer, body), [result, value])
        return result

    _op_reduce_max = _op_reduce_min = _op_reduce_sum

    def _product(self, first, second, shape):
        first = self.dense_copy(self.array(first))
        second = self.dense_copy(self.array(second))
        rows, inner = first.shape[-2:]
        columns = shape[-1]
        out = self.new(shape)
        batches = math.prod(shape[:-2])
        arrays = (first, second, out)
        sizes = (rows * inner, inner * columns, rows * columns)
        for k in range(batches):
            places = [
                replace(array, offset=array.offset + k * size).start
                for array, size in zip(arrays, sizes, strict=True)
            ]
            self.emit(f"product({', '.join(places)}, {rows}, {inner}, {columns});", arrays)
        self.multiply_adds += batches * rows * inner * columns
        return out


def _within(shape, axis, start, size):
    """Starts and shape of `size` entries along one axis."""
    starts = [start if a == axis else 0 for a in range(len(shape))]
    return starts, [size if a == axis else extent for a, extent in enumerate(shape)]
