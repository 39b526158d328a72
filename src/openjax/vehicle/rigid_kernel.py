"""The rigid step of many drones in one GPU kernel.

XLA splits the step into some ten kernels, each of which reads and writes all drones' states; with tens of thousands
of drones most of the time is spent on starting them. Here every drone's state is read once and written once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.platform import on_platform, whole_blocks
from openjax.vehicle.componentwise import evaluate, split
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.state import DroneState

DRONES = 128
"""Drones of one program."""
WARPS = 4

OneStep = Callable[[Vehicle, DroneState, jax.Array], DroneState]


def step_many(one: OneStep, vehicle: Vehicle, drones: DroneState, command) -> DroneState:
    """`one(vehicle, drone, command)` for each of n drones (leading axis) of one vehicle, float32 throughout.

    The drones have no effect memory. On NVIDIA GPUs in one kernel, elsewhere mapped. May be mapped further, over drones
    (still one kernel) and vehicles (not); derivatives are those of `one`.
    """
    return _mapped_step(one)(vehicle, drones, command)


@functools.lru_cache(maxsize=64)
def _mapped_step(one):
    """`step_many` of one function. A further mapped axis becomes more drones."""
    mapped = jax.vmap(one, (None, 0, 0))

    @jax.custom_batching.custom_vmap
    def step(vehicle, drones, command):
        return on_platform(mapped, functools.partial(kernel_call, one))(vehicle, drones, command)

    @step.def_vmap
    def _(axis_size, in_batched, vehicle, drones, command):
        if any(jax.tree.leaves(in_batched[0])):
            axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(in_batched))
            stepped = jax.vmap(mapped, axes)(vehicle, drones, command)
        else:

            def flat(leaf, batched):
                leaf = leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
                return leaf.reshape(-1, *leaf.shape[2:])

            stepped = step(vehicle, *jax.tree.map(flat, (drones, command), tuple(in_batched[1:])))
            stepped = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), stepped)
        return stepped, jax.tree.map(lambda _: True, stepped)

    derived = jax.custom_jvp(step)
    derived.defjvp(lambda primals, tangents: jax.jvp(mapped, primals, tangents))
    return derived


def kernel_call(one: OneStep, vehicle: Vehicle, drones: DroneState, command, interpret=False) -> DroneState:
    """`step_many` by the kernel; `interpret` runs it anywhere, slowly."""
    number = command.shape[0]
    leaves, structure = jax.tree.flatten((drones, command))
    leaves = [whole_blocks(leaf, DRONES, mode="edge") for leaf in leaves]
    constants = jax.tree.leaves(vehicle)
    shapes = [jnp.shape(leaf) for leaf in constants]
    packed = jnp.concatenate([jnp.ravel(leaf) for leaf in constants])
    # a block's size is a power of two
    packed = jnp.pad(packed, (0, (1 << (packed.shape[0] - 1).bit_length()) - packed.shape[0]))
    traced = jax.make_jaxpr(one)(vehicle, *structure.unflatten([leaf[0] for leaf in leaves]))
    results = len(jax.tree.leaves(drones))

    def kernel(packed_ref, *refs):
        inputs, outputs = refs[: len(leaves)], refs[len(leaves) :]
        arguments, start = [], 0
        for shape in shapes:
            size = int(np.prod(shape))
            arguments.append(split(packed_ref[start + i] for i in range(size)).reshape(shape))
            start += size
        for ref in inputs:
            arguments.append(split(ref[:, i] for i in range(ref.shape[1])))
        for ref, values in zip(outputs, evaluate(traced, arguments), strict=True):
            for i, value in enumerate(values):
                ref[:, i] = jnp.broadcast_to(value, (DRONES,))

    blocks = [pl.BlockSpec((DRONES, leaf.shape[1]), lambda i: (i, 0)) for leaf in leaves]
    stepped = pl.pallas_call(
        kernel,
        out_shape=[jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves[:results]],
        grid=(leaves[0].shape[0] // DRONES,),
        in_specs=[pl.BlockSpec(packed.shape, lambda i: (0,)), *blocks],
        out_specs=blocks[:results],
        input_output_aliases={i + 1: i for i in range(results)},
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="rigid_step",
    )(packed, *leaves)
    return jax.tree.unflatten(jax.tree.structure(drones), [leaf[:number] for leaf in stepped])
