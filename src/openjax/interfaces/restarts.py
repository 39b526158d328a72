"""Automatic restarts that cost what they do: of many worlds, those whose episode has
ended start anew, and no start is drawn for the others.

Mapped over worlds, a condition becomes a choice between two results that are both
computed, so a plain automatic restart draws a task with its pillars for each world in
each step. Here the mapped function sees all worlds at once (`jax.custom_batching`) and
draws as many starts as are needed: none in most steps.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

SHARE = 256
"""Starts are drawn for one world in so many at a time, as often as worlds wait for one.
An episode of 800 steps ends in one world of 800 a step, if episodes aren't in step.
"""


def make_restart(start: Callable[[jax.Array], Any]) -> Callable[[Any, Any, Any], Any]:
    """A function `restart(over, key, state)` that returns `start(key)` where `over`, and
    `state` elsewhere. Map it over worlds with `jax.vmap`; the numbers are those of a
    start drawn for each.

    Args:
      start: from () key to a tree with the structure of the states.
    """

    @custom_vmap
    def restart(over, key, state):
        return jax.lax.cond(over, lambda: start(key), lambda: state)

    @restart.def_vmap
    def restart_worlds(worlds, is_mapped, over, keys, states):
        over, keys, states = (
            _with_axis(worlds, has_axis, tree)
            for has_axis, tree in zip(is_mapped, (over, keys, states), strict=True)
        )
        batch = max(1, worlds // SHARE)

        def start_some(carry):
            waiting, states = carry
            place = jnp.nonzero(waiting, size=batch, fill_value=worlds)[0]
            fresh = jax.vmap(start)(keys.at[place].get(mode="clip"))
            states = jax.tree.map(
                lambda old, new: old.at[place].set(new, mode="drop"), states, fresh
            )
            return waiting.at[place].set(False, mode="drop"), states

        _, states = jax.lax.while_loop(lambda carry: jnp.any(carry[0]), start_some, (over, states))
        return states, jax.tree.map(lambda _: True, states)

    return restart


def _with_axis(worlds, has_axis, tree):
    """The tree with its worlds' axis in each leaf."""

    def leaf(has_axis, value):
        return value if has_axis else jnp.broadcast_to(value, (worlds, *jnp.shape(value)))

    return jax.tree.map(leaf, has_axis, tree)
