"""When worlds start: in groups, one of which ends its episodes after each rollout, and some anew in between."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class Schedule:
    """World e of E belongs to start group e mod `groups`; `share` neighbours of a group fly the same task.

    Ages are counted in rollouts. In each training step the group of age `groups` ends its episodes. Of the other groups
    the worlds of every `restart_every`-th task start anew when the group's age is one of `restart_ages`.
    """

    groups: int
    share: int
    restart_every: int = 0
    """0: no world starts anew within an episode."""
    restart_ages: tuple[int, ...] = ()

    def first(self, tasks: Any, number: int) -> Any:
        """Tasks (number, ...) drawn one group after the other, in the order of the worlds."""

        def spread(x):
            x = jnp.moveaxis(x.reshape(self.groups, -1, *x.shape[1:]), 0, 1)
            return x.reshape(number, *x.shape[2:])

        return jax.tree.map(spread, tasks)

    def age(self, number: int) -> jax.Array:
        """(number,) int32 rollouts that each world has behind it at the start of a run."""
        return jnp.arange(number, dtype=jnp.int32) % self.groups

    def ending(self, update: jax.Array) -> jax.Array:
        """() the group whose episodes end with this training step."""
        return (self.groups - 1 - update) % self.groups

    def members(self, worlds: Any, group: jax.Array) -> Any:
        """The worlds of a group, of every leaf's leading axis."""

        def take(x):
            split = x.reshape(x.shape[0] // self.groups, self.groups, *x.shape[1:])
            return jax.lax.dynamic_index_in_dim(split, group, axis=1, keepdims=False)

        return jax.tree.map(take, worlds)

    def with_members(self, worlds: Any, new: Any, group: jax.Array) -> Any:
        """`worlds` with those of a group replaced by `new`."""

        def put(x, new):
            split = x.reshape(x.shape[0] // self.groups, self.groups, *x.shape[1:])
            return jax.lax.dynamic_update_index_in_dim(split, new, group, axis=1).reshape(x.shape)

        return jax.tree.map(put, worlds, new)

    def restarts(self, number: int) -> int:
        """How many of `number` worlds start anew in a training step, beside those whose episodes ended."""
        if not self.restart_every:
            return 0
        return number // self.groups // self.restart_every * len(self.restart_ages)

    def with_restarts(self, worlds: Any, new: Any, ending: jax.Array) -> Any:
        """`worlds` with those that start anew replaced by `new`, where the group `ending` ends its episodes."""
        groups = (ending + np.array(self.restart_ages)) % self.groups

        def put(x, new):
            split = x.reshape(-1, self.restart_every, self.share, self.groups, *x.shape[1:])
            new = jnp.swapaxes(new.reshape(split.shape[0], len(groups), self.share, *x.shape[1:]), 1, 2)
            return split.at[:, 0].set(split[:, 0].at[:, :, groups].set(new)).reshape(x.shape)

        return jax.tree.map(put, worlds, new)

    def lasting(self, number: int) -> np.ndarray:
        """(number,) bool of a group's members: those that are never started anew within an episode."""
        task = np.arange(number) // self.share
        return task % self.restart_every != 0 if self.restart_every else np.ones(number, bool)
