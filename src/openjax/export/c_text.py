"""Pieces of C99 as text: operations, literals, loops and the product of matrices."""

import math

import numpy as np

FUNCTIONS = {
    "tanh": "tanhf({})",
    "exp": "expf({})",
    "log": "logf({})",
    "sqrt": "sqrtf({})",
    "rsqrt": "(1.0f / sqrtf({}))",
    "logistic": "(1.0f / (1.0f + expf(-{})))",
    "sin": "sinf({})",
    "cos": "cosf({})",
    "erf": "erff({})",
}
"""Operations that take a processor a function of the library."""
ELEMENTWISE = {
    "add": "({} + {})",
    "sub": "({} - {})",
    "mul": "({} * {})",
    "div": "({} / {})",
    "add_any": "({} + {})",
    "max": "fmaxf({}, {})",
    "min": "fminf({}, {})",
    "pow": "powf({}, {})",
    "neg": "(-{})",
    "abs": "fabsf({})",
    "lt": "(float)({} < {})",
    "le": "(float)({} <= {})",
    "gt": "(float)({} > {})",
    "ge": "(float)({} >= {})",
    "eq": "(float)({} == {})",
    "ne": "(float)({} != {})",
    "and": "(float)({} != 0.0f && {} != 0.0f)",
    "or": "(float)({} != 0.0f || {} != 0.0f)",
    "not": "(float)({} == 0.0f)",
    "floor": "floorf({})",
    "select_n": "({0} != 0.0f ? {2} : {1})",
    "clamp": "fminf(fmaxf({1}, {0}), {2})",
    **FUNCTIONS,
}


def index_names(shape) -> list[str]:
    """Names of the indices of an array, "0" along axes of one entry."""
    return ["0" if size == 1 else f"i{axis}" for axis, size in enumerate(shape)]


def loops(sizes, indices, body: str) -> str:
    """`body` for all values of the indices that vary."""
    heads = [
        f"for (int {i} = 0; {i} < {size}; {i}++)"
        for i, size in zip(indices, sizes, strict=True)
        if str(i) != "0"
    ]
    if "\n" in body:
        body = "{\n" + indent(body) + "\n}"
    return "\n".join(
        [*(4 * " " * k + head for k, head in enumerate(heads)), indent(body, len(heads))]
    )


def indent(text: str, times: int = 1) -> str:
    """Lines moved in by four spaces, `times` over."""
    return "\n".join(4 * " " * times + line for line in text.splitlines())


def literal(number: float) -> str:
    """A float32 constant; negative ones in brackets."""
    if math.isinf(number):
        return "INFINITY" if number > 0 else "-INFINITY"
    if math.isnan(number):
        return "NAN"
    # nine digits tell every float32 from its neighbours; a literal without a point
    # would be an int
    text = f"{np.float32(number):.9g}"
    text = text if any(c in text for c in ".e") else text + ".0"
    return f"({text}f)" if number < 0 else f"{text}f"


def dims(shape) -> str:
    """A shape for comments."""
    return "(" + ", ".join(map(str, shape)) + ")"


def number_rows(value: np.ndarray) -> str:
    """Entries of a const array (N,), eight to a line."""
    # brackets are for negative numbers within formulas
    literals = [literal(number).strip("()") for number in value.tolist()]
    return "\n".join(", ".join(literals[k : k + 8]) + "," for k in range(0, len(literals), 8))
