"""The operands of an attention, and their sizes."""

from typing import NamedTuple

import jax


class EntityKind(NamedTuple):
    """Entities of one kind: `count` of them, `size` numbers each."""

    count: int
    size: int


class Layout(NamedTuple):
    """Static sizes of the attention."""

    features: int
    heads: int
    kinds: tuple[EntityKind, ...]
    scale: float

    @property
    def entities(self) -> list[tuple[int, int, int]]:
        """(row of the first input, size, row of the first weight) of every entity but
        the pursuer itself.
        """
        rows = []
        row = 0
        weight = 0
        for kind in self.kinds:
            for _ in range(kind.count):
                rows.append((row, kind.size, weight))
                row += kind.size
            weight += kind.size + 2
        return rows

    @property
    def input_rows(self) -> int:
        """Numbers of all entities; a bias on each entity's score follows them."""
        return sum(kind.count * kind.size for kind in self.kinds)


class Operands(NamedTuple):
    """The operands of an attention for B samples; all but `inputs` are differentiable."""

    query: jax.Array
    """(B, heads * features), one query per head in the space of the embeddings"""
    token: jax.Array
    """(B, features), the pursuer itself"""
    inputs: jax.Array
    """(input_rows + entities, B) float32: all entities' numbers, then the biases (a
    large negative one masks); samples last, so that a kernel reads neighbours' numbers
    in one go
    """
    inverse: jax.Array
    """(entities, B) float32, by which the linear layer's output is scaled"""
    weights: jax.Array
    """(sum of size + 2 over kinds, features) float32: per kind its matrix W, then b and
    c
    """
