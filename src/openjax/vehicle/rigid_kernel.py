"""The rigid step of many worlds in one GPU kernel.

XLA splits the step into some ten kernels (more with contacts), each of which reads and writes all
drones' states; with tens of thousands of drones most of the time is spent on starting them. Here
every drone's state is read once and written once. One thread holds all drones of a world, which
therefore know of each other without a detour through memory.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.componentwise import evaluate, split
from openjax.platform import on_platform, whole_blocks
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.solids import Surroundings, others, surroundings
from openjax.vehicle.state import DroneState

WORTH = 16384
"""Worlds from which the kernel is taken: it saves microseconds a step, and the compiler needs half
a minute for it.
"""
WORLDS = 128
"""Worlds of one program."""
WARPS = 4


class FusedStep(NamedTuple):
    """What a step does to one drone: hashable, since compiled code is kept for each."""

    substep: Callable[[Vehicle, DroneState, jax.Array, Surroundings | None], DroneState]
    """(vehicle, drone, command (4,), what is around it or None in free flight) -> the drone a
    substep later.
    """
    substeps: int


def step_many(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars=None
) -> DroneState:
    """The n drones (leading axis) of one world after a step.

    The drones are of one vehicle and have no effect memory. `pillars`: position (P, 2) m and active
    (P,) bool, or None for free flight, in which drones don't notice each other. On NVIDIA GPUs in
    one kernel, elsewhere mapped. May be mapped further, over worlds (still one kernel) and vehicles
    (not); derivatives are those of `looped_step`, and whatever isn't float32 is done by
    `mapped_step`.
    """
    if drones.position.dtype != jnp.float32:
        return mapped_step(step, vehicle, drones, command, pillars or ())
    if pillars is None:  # every drone is a world of its own
        alone = jax.tree.map(lambda leaf: leaf[:, None], (drones, command))
        return jax.tree.map(lambda leaf: leaf[:, 0], _many_worlds(step)(vehicle, *alone, ()))
    world = jax.tree.map(lambda leaf: leaf[None], (drones, command, tuple(pillars)))
    return jax.tree.map(lambda leaf: leaf[0], _many_worlds(step)(vehicle, *world))


def mapped_step(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars
) -> DroneState:
    """The n drones of one world after a step, by the formulas as they stand; `pillars` () in free
    flight.
    """
    for _ in range(step.substeps):
        around = surroundings(drones.position, drones.velocity, *pillars) if pillars else None
        drones = jax.vmap(step.substep, (None, 0, 0, 0))(vehicle, drones, command, around)
    return drones


def looped_step(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars
) -> DroneState:
    """The same by a loop over the substeps, each of which is done again in the backward pass.

    A gradient through substeps written out one after the other takes five times as long on a CPU,
    and to compile.
    """

    @jax.checkpoint
    def substep(drones, _):
        return mapped_step(step._replace(substeps=1), vehicle, drones, command, pillars), None

    return jax.lax.scan(substep, drones, None, length=step.substeps)[0]


@functools.lru_cache(maxsize=64)
def _many_worlds(step):
    """`step` of W worlds. A further mapped axis becomes more worlds."""
    mapped = jax.vmap(functools.partial(mapped_step, step), (None, 0, 0, 0))

    @jax.custom_batching.custom_vmap
    def run(vehicle, drones, command, pillars):
        if command.shape[0] < WORTH:
            return mapped(vehicle, drones, command, pillars)
        return on_platform(mapped, functools.partial(kernel_call, step))(
            vehicle, drones, command, pillars
        )

    @run.def_vmap
    def _(axis_size, in_batched, vehicle, *worlds):
        if any(jax.tree.leaves(in_batched[0])):
            axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(in_batched))
            stepped = jax.vmap(mapped, axes)(vehicle, *worlds)
        else:

            def flat(leaf, batched):
                leaf = leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
                return leaf.reshape(-1, *leaf.shape[2:])

            stepped = run(vehicle, *jax.tree.map(flat, worlds, tuple(in_batched[1:])))
            stepped = jax.tree.map(
                lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), stepped
            )
        return stepped, jax.tree.map(lambda _: True, stepped)

    derived = jax.custom_jvp(run)
    looped = jax.vmap(functools.partial(looped_step, step), (None, 0, 0, 0))
    derived.defjvp(lambda primals, tangents: jax.jvp(looped, primals, tangents))
    return derived


def kernel_call(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars, interpret=False
) -> DroneState:
    """`step` of W worlds of n drones by the kernel; `interpret` runs it anywhere, slowly.

    drones (W, n, ...), command (W, n, 4), pillars () or (W, P, 2) and (W, P).
    """
    number, n = command.shape[:2]
    if pillars:
        pillars = (pillars[0], pillars[1].astype(jnp.float32))
    leaves, structure = jax.tree.flatten((drones, command))
    results = len(leaves) - 1
    inputs = [leaf.reshape(number, -1) for leaf in (*leaves, *pillars)]
    inputs = [whole_blocks(leaf, WORLDS, mode="edge") for leaf in inputs]
    constants = jax.tree.leaves(vehicle)
    packed = jnp.concatenate([jnp.ravel(leaf) for leaf in constants])
    # a block's size is a power of two
    packed = jnp.pad(packed, (0, (1 << (packed.shape[0] - 1).bit_length()) - packed.shape[0]))

    drone, one_command = structure.unflatten([leaf[0, 0] for leaf in leaves])
    around = None
    if pillars:
        first = jax.tree.map(lambda leaf: leaf[0], (drones, pillars))
        around = surroundings(first[0].position, first[0].velocity, first[1][0], first[1][1] > 0)
        around = jax.tree.map(lambda leaf: leaf[0], around)
    traced = jax.make_jaxpr(step.substep)(vehicle, drone, one_command, around)

    def kernel(packed_ref, *refs):
        vehicle_parts = []
        start = 0
        for leaf in constants:
            parts = split(packed_ref[start + i] for i in range(leaf.size))
            vehicle_parts.append(parts.reshape(leaf.shape))
            start += leaf.size
        parts = [split(ref[:, i] for i in range(ref.shape[1])) for ref in refs[: len(inputs)]]
        world = [
            p.reshape(n, *leaf.shape[2:]) for p, leaf in zip(parts[:results], leaves, strict=False)
        ]
        commands = parts[results].reshape(n, 4)
        solids = []
        if pillars:
            position, active = parts[results + 1 :]
            solids = [position.reshape(-1, 2), split(part > 0.5 for part in active)]
        for _ in range(step.substeps):
            now = structure.unflatten([*world, commands])[0]
            moved = []
            for i in range(n):
                own = [leaf[i] for leaf in world]
                seen = [now.position[others(n)[i]], now.velocity[others(n)[i]]] if pillars else []
                moved.append(evaluate(traced, [*vehicle_parts, *own, commands[i], *solids, *seen]))
            world = [np.stack(leaf) for leaf in zip(*moved, strict=True)]
        for ref, values in zip(refs[len(inputs) :], world, strict=True):
            for i, value in enumerate(values.ravel()):
                ref[:, i] = jnp.broadcast_to(value, (WORLDS,))

    blocks = [pl.BlockSpec((WORLDS, leaf.shape[1]), lambda i: (i, 0)) for leaf in inputs]
    stepped = pl.pallas_call(
        kernel,
        out_shape=[jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in inputs[:results]],
        grid=(inputs[0].shape[0] // WORLDS,),
        in_specs=[pl.BlockSpec(packed.shape, lambda i: (0,)), *blocks],
        out_specs=blocks[:results],
        input_output_aliases={i + 1: i for i in range(results)},
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="rigid_step",
    )(packed, *inputs)
    stepped = [leaf[:number].reshape(old.shape) for leaf, old in zip(stepped, leaves, strict=False)]
    return jax.tree.unflatten(jax.tree.structure(drones), stepped)
