"""The active archive: unsolved tasks as a pytree of arrays (the paper's Q_active)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PRNGKeyArray


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TaskArchive:
    """Tasks (any pytree) with leading axis C (capacity). Used slots come first, newest
    first.
    """

    tasks: Any
    success: Float[Array, " capacity"]
    """Success rate at which each task entered."""
    size: Int32[Array, ""]
    """Used slots."""

    def replace(self, **changes) -> "TaskArchive":
        """A copy with other values for the fields named."""
        return dataclasses.replace(self, **changes)


def empty_archive(task: Any, capacity: int) -> TaskArchive:
    """An archive without tasks, for tasks like `task`."""
    return TaskArchive(
        tasks=jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), task),
        success=jnp.zeros((capacity,), jnp.float32),
        size=jnp.zeros((), jnp.int32),
    )


def insert(
    archive: TaskArchive,
    tasks: Any,
    success: Float[Array, " new"],
    is_accepted: Bool[Array, " new"],
    descriptor: Callable[[Any], Float[Array, "tasks features"]],
) -> TaskArchive:
    """Add the accepted ones of M tasks; where there are more than slots, keep the
    spread.

    Every task's novelty is its distance to the nearest *newer* one, and the most novel
    stay: of a cluster the newest member survives and the older ones go first. One
    matrix product, no host, no sequential choice; farthest-point sampling, which the
    paper's code runs on the host, has the same aim.

    Args:
      archive: C slots.
      tasks: leading axis M, newest last.
      success: their success rates.
      is_accepted: which of them enter.
      descriptor: of tasks (M, ...) the (M, D) numbers by whose distance they are told
      apart.
    """
    capacity = archive.success.shape[0]
    m = success.shape[0]
    chex.assert_tree_shape_prefix(tasks, (m,))
    # newest first, as the archive is
    pool = jax.tree.map(lambda new, old: jnp.concatenate([new[::-1], old]), tasks, archive.tasks)
    pool_success = jnp.concatenate([success[::-1], archive.success])
    is_used = jnp.concatenate([is_accepted[::-1], jnp.arange(capacity) < archive.size])

    features = descriptor(pool)
    # |a - b|^2 = |a|^2 + |b|^2 - 2 ab, all pairs by one matrix product; in full
    # precision, as what is left of it between close tasks is a small difference of
    # large numbers
    squares = jnp.sum(features**2, axis=-1)
    product = jnp.matmul(features, features.T, precision=jax.lax.Precision.HIGHEST)
    distance = squares[:, None] + squares[None] - 2.0 * product
    index = jnp.arange(m + capacity)
    newer = (index[None] < index[:, None]) & is_used[None]
    novelty = jnp.min(jnp.where(newer, jnp.maximum(distance, 0.0), jnp.inf), axis=1)
    # a squared distance is never negative: unused slots come behind all used ones
    novelty = jnp.where(is_used, novelty, -1.0)

    # the newest of all has nobody newer: its novelty is infinite, and it always stays
    slot = jax.lax.top_k(novelty, capacity)[1]
    # back to newest first, unused last: sorted by age, with the unused ones moved
    # behind all
    total = m + capacity
    slot = jnp.sort(jnp.where(is_used[slot], slot, slot + total)) % total
    return TaskArchive(
        tasks=jax.tree.map(lambda leaf: leaf[slot], pool),
        success=pool_success[slot],
        size=jnp.minimum(jnp.sum(is_used), capacity).astype(jnp.int32),
    )


def draw(archive: TaskArchive, key: PRNGKeyArray) -> Any:
    """One used task (leaves without the archive's leading axis), uniformly; of an empty
    archive zeros: check `size` first.
    """
    slot = jax.random.randint(key, (), 0, jnp.maximum(archive.size, 1))
    return jax.tree.map(lambda leaf: leaf[slot], archive.tasks)
