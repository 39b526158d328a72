"""Block-diagonal matrices, of which a decision makes thousands."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def block_diagonal(
    blocks: Sequence[Float[np.ndarray, "_ _"]],
) -> Float[np.ndarray, "entries entries"]:
    """As SciPy's `block_diag` of float64 matrices, at a tenth of its time for small
    ones.
    """
    size = sum(len(block) for block in blocks)
    out = np.zeros((size, size))
    begin = 0
    for block in blocks:
        end = begin + len(block)
        out[begin:end, begin:end] = block
        begin = end
    return out
