"""A JAX function as a plain C99 program: no allocation, no library but `math.h`,
weights as const arrays.

The function is traced and what doesn't depend on its inputs is computed, as for ONNX.
Intermediate arrays share one workspace, which the caller provides.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jinja2

from openjax.export.c_statements import Buffer, Writer, dense_array
from openjax.export.c_text import dims, number_rows
from openjax.export.traced import trace
from openjax.pursuit.teams import draws_below

_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    trim_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
)
_TEMPLATES.filters |= {"dims": dims, "number_rows": number_rows, "product": math.prod}


class DrawnStrategies(NamedTuple):
    """The rule by which a team draws the strategy that it flies."""

    strategies: int
    """As many."""
    steps: int
    """Control steps between two draws."""
    seconds: float
    """s between two draws."""
    odds: tuple[float, ...] = ()
    """Of each, in any unit; empty: all have the same."""

    @property
    def shares(self) -> tuple[float, ...]:
        """The probability of each; they add up to 1."""
        odds = self.odds or (1.0,) * self.strategies
        return tuple(one / sum(odds) for one in odds)

    @property
    def below(self) -> tuple[int, ...]:
        """A draw of 32 bits below the first number means strategy 0, below the second
        strategy 1, and so on.
        """
        ends = draws_below(self.shares)
        return tuple(min(int(end * 2**32), 2**32 - 1) for end in ends)

    def in_words(self) -> str:
        """Instructions for the program that calls an exported policy."""
        return (
            f"strategy is drawn by the program that calls the policy: a whole number from 0 to "
            f"{self.strategies - 1}, {self._odds_in_words()}, when a game begins and every "
            f"{self.steps} control steps ({self.seconds:g} s); all pursuers of a team take the "
            "same one. A team that always flies one strategy is beaten far more often"
        )

    def _odds_in_words(self) -> str:
        if len(set(self.shares)) == 1:
            return "with equal odds"
        return "with probabilities " + ", ".join(f"{share:.3g}" for share in self.shares)


@dataclass
class CProgram:
    """A generated program and what it takes."""

    header: str
    source: str
    inputs: dict[str, jax.ShapeDtypeStruct]
    """Flags are unsigned char, all others float."""
    shape: tuple[int, ...]
    numbers: int
    """In const arrays."""
    workspace: int
    """Floats."""
    multiply_adds: int
    """In products of matrices, per call."""
    functions: int
    """Evaluations of exp, tanh, sqrt and their kin, per call."""


def _place(buffers: list[Buffer]) -> int:
    """Give all buffers their offsets, so that two that live at once don't overlap; the
    floats needed.
    """
    # the largest first, each into the first gap between those that live while it does
    neighbours: list[Buffer] = []
    for buffer in sorted(buffers, key=lambda buffer: -buffer.size):
        alive = [
            other
            for other in neighbours
            if other.first_write <= buffer.read and buffer.first_write <= other.read
        ]
        others = sorted(alive, key=lambda other: other.offset)
        buffer.offset = 0
        for other in others:
            if buffer.offset + buffer.size <= other.offset:
                break
            buffer.offset = max(buffer.offset, other.offset + other.size)
        neighbours.append(buffer)
    return max((buffer.offset + buffer.size for buffer in buffers), default=1)


def c_program(
    function: Callable,
    inputs: dict[str, jax.ShapeDtypeStruct],
    prefix: str,
    about: str,
    draws: DrawnStrategies | None = None,
) -> CProgram:
    """A C program of `function(**inputs)`, which returns one array, `action`; inputs
    that it doesn't read are left out.

    Args:
      function: to be traced.
      inputs: names and kinds of its arguments; arrays of floats or flags.
      prefix: of all names that the header declares, and of the header's file.
      about: a line for the top of both files.
      draws: where an input `strategy` is drawn, how; a function that does is added.

    Raises:
      UserError: the function uses an operation that isn't covered.
    """
    writer, workspace, shape = _write(function, inputs)
    text = "\n".join(writer.statements)
    buffers_read = {
        name: kind
        for name, kind in inputs.items()
        if f"in->{name}[" in text or f"in->{name}," in text
    }
    values = {
        "about": about,
        "prefix": prefix,
        "inputs": buffers_read,
        "draws": draws if "strategy" in buffers_read else None,
        "shape": shape,
        "workspace": workspace,
        "writer": writer,
        "statements": text,
    }
    return CProgram(
        header=_TEMPLATES.get_template("program.h.jinja").render(values),
        source=_TEMPLATES.get_template("program.c.jinja").render(values),
        inputs=buffers_read,
        shape=shape,
        numbers=sum(value.size for value in writer.constants),
        workspace=workspace,
        multiply_adds=writer.multiply_adds,
        functions=writer.functions,
    )


def _write(function, inputs):
    """The statements of a function, the floats of workspace that they need, and the
    shape of its result.
    """
    program = trace(function, inputs)
    writer = Writer()
    arrays = [dense_array(f"in->{name}", kind.shape) for name, kind in inputs.items()]
    (result,) = writer.run(program.jaxpr, program.consts, arrays)
    shape = tuple(program.out_avals[0].shape)
    writer.write(dense_array("action", shape), "{}", [writer.array(result)])
    return writer, _place(writer.buffers), shape
