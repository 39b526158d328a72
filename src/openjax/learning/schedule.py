"""The schedule by which worlds start: in groups, one of which ends its episodes after each rollout,
while some worlds restart in between.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32

from openjax.pursuit.shapes import Count


@dataclass(frozen=True)
class Schedule:
    """World e of E belongs to start group e mod `groups`; `share` neighbours of a group
    fly the same task.

    Ages are counted in rollouts. In each training step the group of age `groups` ends
    its episodes. Of the other groups the worlds of every `restart_every`-th task start
    anew when the group's age is one of `restart_ages`.
    """

    groups: int
    share: int
    restart_every: int = 0
    """0: no world starts anew within an episode."""
    restart_ages: tuple[int, ...] = ()

    def first(self, tasks: Any, number: int) -> Any:
        """Tasks (number, ...) drawn one group after the other, in the order of the
        worlds.
        """

        # drawn group by group, they are dealt out: world e belongs to group e mod
        # `groups`
        def spread(x):
            x = jnp.moveaxis(x.reshape(self.groups, -1, *x.shape[1:]), 0, 1)
            return jax.lax.collapse(x, 0, 2)

        return jax.tree.map(spread, tasks)

    def age(self, number: int) -> Int32[Array, " {number}"]:
        """(number,) int32 rollouts that each world has behind it at the start of a
        run.
        """
        return jnp.arange(number, dtype=jnp.int32) % self.groups

    def ending(self, update: Count) -> Count:
        """() the group whose episodes end with this training step."""
        # group g starts with age g: the last group's episodes end first
        return (self.groups - 1 - update) % self.groups

    def members(self, worlds: Any, group: Count) -> Any:
        """The worlds of a group, of every leaf's leading axis."""

        def take(x):
            split = x.reshape(x.shape[0] // self.groups, self.groups, *x.shape[1:])
            return jax.lax.dynamic_index_in_dim(split, group, axis=1, keepdims=False)

        return jax.tree.map(take, worlds)

    def restarts(self, number: int) -> int:
        """The number of `number` worlds that restart in a training step, beside those whose
        episodes ended.
        """
        if not self.restart_every:
            return 0
        return number // self.groups // self.restart_every * len(self.restart_ages)

    def renew(self, worlds: Any, fresh: Any, ending: Count) -> Any:
        """`worlds` (E, ...) with `fresh` ones in place of the group `ending`, and then
        of those that start anew.
        """
        number = jax.tree.leaves(worlds)[0].shape[0]
        member, group = np.divmod(np.arange(number), self.groups)
        task, neighbour = np.divmod(member, self.share)
        every = self.restart_every or 1
        ages = len(self.restart_ages)
        # which of the restart ages a group has, by how far it is behind the one that
        # ends; -1: none
        age_place = np.full(self.groups, -1)
        if self.restart_every:
            age_place[list(self.restart_ages)] = np.arange(ages)
        behind = (group - ending) % self.groups
        restart = jnp.where(task % every == 0, jnp.asarray(age_place)[behind], -1)

        # one gather from [old worlds, fresh ones of the ending group, fresh ones of
        # restarts]: each world says from which place of these three it comes
        ending_size = number // self.groups
        place = (task // every * ages + restart) * self.share + neighbour
        source = jnp.where(restart < 0, np.arange(number), number + ending_size + place)
        # last, so that it has the word: what ends its episode is not started anew as
        # well
        source = jnp.where(behind == 0, number + member, source)
        return jax.tree.map(lambda x, new: jnp.concatenate([x, new])[source], worlds, fresh)

    def lasting(self, number: int) -> Bool[np.ndarray, " {number}"]:
        """(number,) bool of a group's members: those that are never started anew within
        an episode.
        """
        task = np.arange(number) // self.share
        return task % self.restart_every != 0 if self.restart_every else np.ones(number, bool)
