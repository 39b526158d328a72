"""The training step as the programs that a run calls: compiled side by side, taken from earlier runs' traces where kept."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from openjax.background import compile_ahead
from openjax.cluster.devices import carry_shardings, everywhere, flown_shardings
from openjax.commands.training_loop import guarded
from openjax.learning import TrainCarry
from openjax.learning.training_step import Phases


@dataclass(frozen=True)
class StepPrograms:
    """The training step `carry -> (carry, metrics, broken)`, as `openjax.commands.training_loop.guarded` has it.

    What was flown goes from program to program as the leaves of its tree: a kept program knows no other types.
    """

    fly: Callable[[TrainCarry], tuple[TrainCarry, tuple[jax.Array, ...], dict]]
    learn: tuple[Callable[[TrainCarry, tuple[jax.Array, ...]], tuple[TrainCarry, dict]], ...]
    renew: Callable[[TrainCarry], tuple[TrainCarry, dict, jax.Array]]
    flown: tuple[jax.ShapeDtypeStruct, ...]

    def __call__(self, carry: TrainCarry) -> tuple[TrainCarry, dict, jax.Array]:
        """One step; the carry is donated."""
        carry, flown, metrics = self.fly(carry)
        for learn in self.learn:
            carry, watched = learn(carry, flown)
            metrics |= watched
        del flown
        carry, counted, broken = self.renew(carry)
        return carry, metrics | counted, broken

    def compile_ahead(self, carry: TrainCarry) -> Callable[..., bool]:
        """Start to compile for a carry of this kind; see `openjax.background.compile_ahead`."""
        ready = [
            compile_ahead(learn, carry, self.flown) for learn in reversed(self.learn)
        ]  # the longest first
        ready += [compile_ahead(self.fly, carry), compile_ahead(self.renew, carry)]
        return lambda seconds=None: all([wait(seconds) for wait in ready])


def step_programs(
    phases: Phases,
    devices: int,
    carry: TrainCarry,
    keep: Callable[[str, Callable, Callable[[], tuple]], Callable] | None = None,
) -> StepPrograms:
    """The programs of the phases.

    Args:
      phases: from `openjax.cluster.devices.make_device_phases`.
      devices: number of devices.
      carry: shapes, dtypes and shardings of a run's carry.
      keep: (name, program, its arguments) -> the program as an earlier run traced it.
    """
    shardings, same = carry_shardings(devices), everywhere(devices)
    compiled = functools.partial(jax.jit, donate_argnums=0)
    fly_tree = jax.jit(phases.fly)

    @functools.cache
    def flown():
        """What is flown, shapes for arrays: it takes a trace."""
        shapes = jax.eval_shape(fly_tree, carry)[1]
        at = jax.tree.broadcast(flown_shardings(devices), shapes)
        return jax.tree.map(lambda s, at: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=at), shapes, at)

    def fly(carry):
        carry, flown, metrics = fly_tree(carry)
        return carry, tuple(jax.tree.leaves(flown)), metrics

    def learn(phase, carry, leaves):
        return phase(carry, jax.tree.unflatten(jax.tree.structure(flown()), leaves))

    def arguments():
        return carry, tuple(jax.tree.leaves(flown()))

    learners = [functools.partial(learn, phase) for phase in phases.learn]
    renew = guarded(phases.renew, shardings, same)
    if keep is None:
        leaves = arguments()[1]
        at: Any = tuple(leaf.sharding for leaf in leaves)
    else:
        fly = keep("fly", jax.jit(fly), lambda: (carry,))
        learners = [keep(f"learn_{i}", jax.jit(learner), arguments) for i, learner in enumerate(learners)]
        renew = compiled(keep("renew", renew, lambda: (carry,)), out_shardings=(shardings, same, same))
        at = same
        leaves = tuple(
            jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=same)
            for leaf in jax.eval_shape(fly, carry)[1]
        )
    return StepPrograms(
        compiled(fly, out_shardings=(shardings, at, same)),
        tuple(compiled(learner, out_shardings=(shardings, same)) for learner in learners),
        renew,
        leaves,
    )
