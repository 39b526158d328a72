"""The training step as the programs that a run calls: compiled side by side, taken from earlier runs' traces where kept."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax

from openjax.background import compile_ahead
from openjax.cluster.devices import carry_shardings, compiler_options, everywhere, flown_shardings
from openjax.commands.training_loop import guarded
from openjax.learning import TrainCarry
from openjax.learning.training_step import Phases

Parts = tuple[tuple[jax.Array, ...], ...]


@dataclass(frozen=True)
class StepPrograms:
    """The training step `carry -> (carry, metrics, broken)`, as `openjax.commands.training_loop.guarded` has it.

    What was flown goes from program to program as the leaves of its parts: a kept program knows no other types.
    """

    fly: Callable[[TrainCarry], tuple[TrainCarry, Parts, dict]]
    learn: tuple[Callable[[TrainCarry, Parts], tuple[TrainCarry, dict]], ...]
    renew: Callable[[TrainCarry], tuple[TrainCarry, dict, jax.Array]]
    flown: tuple[tuple[jax.ShapeDtypeStruct, ...], ...]

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
    keep: Callable[[str, Callable, Callable[[], tuple]], Callable] = lambda name, program, arguments: program,
) -> StepPrograms:
    """The programs of the phases.

    Args:
      phases: from `openjax.cluster.devices.make_device_phases`.
      devices: number of devices.
      carry: shapes, dtypes and shardings of a run's carry.
      keep: (name, program, its arguments) -> the program as an earlier run traced it.
    """
    shardings, same, at = carry_shardings(devices), everywhere(devices), flown_shardings(devices)
    compiled = functools.partial(jax.jit, donate_argnums=0, compiler_options=compiler_options(devices))
    fly_tree = jax.jit(phases.fly)

    @functools.cache
    def structure():
        """Of what is flown: it takes a trace."""
        return jax.tree.structure(jax.eval_shape(fly_tree, carry)[1])

    def fly(carry):
        carry, flown, metrics = fly_tree(carry)
        return carry, tuple(tuple(jax.tree.leaves(part)) for part in vars(flown).values()), metrics

    def learn(phase, carry, parts):
        return phase(carry, jax.tree.unflatten(structure(), jax.tree.leaves(parts)))

    fly = keep("fly", jax.jit(fly), lambda: (carry,))

    @functools.cache
    def flown():
        """Its parts, shapes for arrays."""
        shapes = jax.eval_shape(fly, carry)[1]
        places = jax.tree.broadcast(at, shapes)
        return jax.tree.map(lambda s, at: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=at), shapes, places)

    learners = [
        keep(f"learn_{i}", jax.jit(functools.partial(learn, phase)), lambda: (carry, flown()))
        for i, phase in enumerate(phases.learn)
    ]
    renew = keep("renew", guarded(phases.renew, shardings, same), lambda: (carry,))
    return StepPrograms(
        compiled(fly, out_shardings=(shardings, at, same)),
        tuple(compiled(learner, out_shardings=(shardings, same)) for learner in learners),
        compiled(renew, out_shardings=(shardings, same, same)),
        flown(),
    )
