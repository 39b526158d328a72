"""The rigid step of many worlds in one GPU kernel.

XLA splits the step into some ten kernels (more with contacts), each of which reads and
writes all drones' states; with tens of thousands of drones most of the time is spent on
starting them. Here every drone's state is read once and written once. One thread holds
one drone, and reads where the others of its world are; loops over pillars and other
drones keep the program small.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as pallas_triton

from openjax.kernels.componentwise import evaluate, split
from openjax.platform import on_platform, whole_blocks
from openjax.vehicle.arena import Arena
from openjax.vehicle.contacts import contact_acceleration, looped_contact_acceleration
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rigid_body import euler_step
from openjax.vehicle.solids import Obstacles, floor, other_drone, pillar, surroundings
from openjax.vehicle.state import DroneState

WORTH = 16384
"""Worlds from which the kernel is taken: it saves microseconds a step, and takes the
compiler seconds.
"""
DRONES = 128
"""Drones of one program."""
WARPS = 4


class FusedStep(NamedTuple):
    """The step of one drone: hashable, since compiled code is kept for each."""

    accelerate: Callable[[Vehicle, DroneState, jax.Array], tuple[DroneState, jax.Array, jax.Array]]
    """(vehicle, drone, command (4,)) -> the drone with its controller and rotors a
    substep later, its accelerations (3,) m/s^2 world and (3,) rad/s^2 body in free
    flight.
    """
    arena: Arena
    dt: float
    """Seconds of a substep."""
    substeps: int

    def one(
        self, vehicle: Vehicle, drone: DroneState, command, around: Obstacles | None
    ) -> DroneState:
        """One drone after a substep, in free flight if nothing is `around`."""
        next_drone, acceleration, angular = self.accelerate(vehicle, drone, command)
        if around is not None:
            extra = contact_acceleration(
                self.arena, drone.position, drone.velocity, acceleration, around, self.dt
            )
            # as by MJX, gradients are those of free flight: what contacts add is a
            # constant to them
            acceleration = acceleration + jax.lax.stop_gradient(extra)
        return euler_step(next_drone, acceleration, angular, self.dt)


def step_many(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars=None
) -> DroneState:
    """The n drones (leading axis) of one world after a step.

    The drones are of one vehicle and have no effect memory. `pillars`: position (P, 2)
    m and active (P,) bool, or None for free flight, in which drones don't notice each
    other. On NVIDIA GPUs in one kernel, elsewhere mapped. May be mapped further, over
    worlds (still one kernel) and vehicles (not); derivatives are those of
    `looped_step`, and whatever isn't float32 is done by `mapped_step`.
    """
    if drones.position.dtype != jnp.float32:
        return mapped_step(step, vehicle, drones, command, pillars or ())
    if pillars is None:  # every drone is a world of its own
        drones, command = jax.tree.map(lambda leaf: leaf[:, None], (drones, command))
        drones_after = _many_worlds(step)(vehicle, drones, command, ())
        return jax.tree.map(lambda leaf: leaf[:, 0], drones_after)
    world = (drones, command, tuple(pillars))
    drones, command, pillars = jax.tree.map(lambda leaf: leaf[None], world)
    drones_after = _many_worlds(step)(vehicle, drones, command, pillars)
    return jax.tree.map(lambda leaf: leaf[0], drones_after)


def mapped_step(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars
) -> DroneState:
    """The n drones of one world after a step, by the formulas as they stand; `pillars`
    () in free flight.
    """
    for _ in range(step.substeps):
        around = None
        if pillars:
            position, active = pillars
            around = surroundings(drones.position, drones.velocity, position, active)
        drones = jax.vmap(step.one, (None, 0, 0, 0))(vehicle, drones, command, around)
    return drones


def looped_step(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars
) -> DroneState:
    """The same by a loop over the substeps, each of which is done again in the backward
    pass.

    A gradient through substeps written out one after the other takes five times as long
    on a CPU, and to compile.
    """

    @jax.checkpoint
    def substep(drones, _):
        return mapped_step(step._replace(substeps=1), vehicle, drones, command, pillars), None

    drones, _ = jax.lax.scan(substep, drones, length=step.substeps)
    return drones


@functools.lru_cache(maxsize=64)
def _many_worlds(step):
    """`step` of W worlds. A further mapped axis becomes more worlds."""
    plain_step = jax.vmap(functools.partial(mapped_step, step), (None, 0, 0, 0))

    @jax.custom_batching.custom_vmap
    def run(vehicle, drones, command, pillars):
        if command.shape[0] < WORTH:
            return plain_step(vehicle, drones, command, pillars)
        fastest = on_platform(plain_step, functools.partial(kernel_call, step))
        return fastest(vehicle, drones, command, pillars)

    @run.def_vmap
    def _(axis_size, in_batched, *arguments):
        vehicle, drones, command, pillars = arguments
        # the kernel holds one vehicle's numbers: of many vehicles it isn't taken
        if any(jax.tree.leaves(in_batched[0])):
            axes = jax.tree.map(lambda is_many: 0 if is_many else None, tuple(in_batched))
            drones_after = jax.vmap(plain_step, axes)(vehicle, drones, command, pillars)
        else:

            def flat(leaf, is_many):
                leaf = leaf if is_many else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
                return jax.lax.collapse(leaf, 0, 2)

            # two axes of worlds become one, and two again afterwards
            worlds = (drones, command, pillars)
            drones, command, pillars = jax.tree.map(flat, worlds, tuple(in_batched[1:]))
            drones_after = run(vehicle, drones, command, pillars)
            drones_after = jax.tree.map(
                lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), drones_after
            )
        return drones_after, jax.tree.map(lambda _: True, drones_after)

    differentiable = jax.custom_jvp(run)
    loop_step = jax.vmap(functools.partial(looped_step, step), (None, 0, 0, 0))
    differentiable.defjvp(lambda primals, tangents: jax.jvp(loop_step, primals, tangents))
    return differentiable


def kernel_call(
    step: FusedStep, vehicle: Vehicle, drones: DroneState, command, pillars, interpret=False
) -> DroneState:
    """`step` of W worlds of n drones by the kernel; `interpret` runs it anywhere,
    slowly.

    drones (W, n, ...), command (W, n, 4), pillars () or (W, P, 2) and (W, P).
    """
    if not pillars or step.substeps == 1:
        return _one_call(step, vehicle, _Worlds(drones, command, pillars), interpret)
    single = step._replace(substeps=1)  # drones see where the others are after each

    def substep(drones, _):
        return _one_call(single, vehicle, _Worlds(drones, command, pillars), interpret), None

    drones, _ = jax.lax.scan(substep, drones, length=step.substeps)
    return drones


class _Worlds(NamedTuple):
    """The inputs of `kernel_call` for W worlds."""

    drones: DroneState
    command: jax.Array
    pillars: tuple

    def rows(self):
        """Leaves of the drones and the commands, drones of all worlds one below the
        other, in whole blocks.
        """
        number = self.command.shape[0] * self.command.shape[1]
        leaves = jax.tree.leaves((self.drones, self.command))
        return [whole_blocks(leaf.reshape(number, -1), DRONES, mode="edge") for leaf in leaves]

    def around(self):
        """The places that each drone looks up: those of all drones and pillars; nothing in free
        flight.
        """
        if not self.pillars:
            return []
        position, active = self.pillars
        return [
            self.drones.position.reshape(-1, 3),
            self.drones.velocity.reshape(-1, 3),
            position.reshape(position.shape[0], -1),
            active.astype(jnp.float32),
        ]

    def unpack(self, rows):
        """The drones again from their leaves' rows."""
        leaves, structure = jax.tree.flatten(self.drones)
        number = self.command.shape[0] * self.command.shape[1]
        full = [row[:number].reshape(leaf.shape) for row, leaf in zip(rows, leaves, strict=True)]
        return structure.unflatten(full)


def _one_call(step, vehicle, worlds, interpret):
    """One kernel; of several substeps only in free flight."""
    rows = worlds.rows()
    around = worlds.around()
    constants = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(vehicle)])
    # a block's size is a power of two
    size = 1 << (constants.shape[0] - 1).bit_length()
    constants = jnp.pad(constants, (0, size - constants.shape[0]))
    outputs = rows[:-1]
    blocks = [pl.BlockSpec((DRONES, leaf.shape[1]), lambda i: (i, 0)) for leaf in rows]
    specs = [pl.BlockSpec(leaf.shape, lambda i: (0, 0)) for leaf in around]
    # position and velocity, the first leaf and the third, aren't written over where
    # others look
    looked_up = {0, 2} if around else set()
    outputs = pl.pallas_call(
        _kernel(step, vehicle, worlds),
        out_shape=[jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in outputs],
        grid=(rows[0].shape[0] // DRONES,),
        in_specs=[pl.BlockSpec(constants.shape, lambda i: (0,)), *blocks, *specs],
        out_specs=blocks[:-1],
        input_output_aliases={i + 1: i for i in range(len(outputs)) if i not in looked_up},
        interpret=interpret,
        compiler_params=pallas_triton.CompilerParams(num_warps=WARPS, num_stages=1),
        name="rigid_step",
    )(constants, *rows, *around)
    return worlds.unpack(outputs)


def _kernel(step, vehicle, worlds):
    """The program of a block of drones, each of which is done component by
    component.
    """
    drone, command = jax.tree.map(lambda leaf: leaf[0, 0], (worlds.drones, worlds.command))
    leaves = jax.tree.leaves(drone)
    accelerate = jax.make_jaxpr(step.accelerate)(vehicle, drone, command)
    move = functools.partial(euler_step, dt=step.dt)
    move = jax.make_jaxpr(move)(drone, drone.position, drone.position)

    def kernel(constants_ref, *refs):
        state = [[ref[:, i] for i in range(ref.shape[1])] for ref in refs[: len(leaves)]]
        command = split(refs[len(leaves)][:, i] for i in range(4))
        around = refs[len(leaves) + 1 : -len(leaves)]
        constants = _numbers(constants_ref, jax.tree.leaves(vehicle))

        def substep(_, state):
            parts = [
                split(row).reshape(leaf.shape) for row, leaf in zip(state, leaves, strict=True)
            ]
            *rotation, free, angular = evaluate(accelerate, [*constants, *parts, command])
            if around:
                drone_before = jax.tree.structure(drone).unflatten(parts)
                free = free + _contacts(step, drone_before, free, worlds.command.shape[:2], around)
            next_parts = evaluate(move, [*rotation, free, angular])
            return [
                [jnp.broadcast_to(part, (DRONES,)) for part in leaf.ravel()] for leaf in next_parts
            ]

        if step.substeps == 1:  # not worth a loop
            state = substep(0, state)
        else:
            state = jax.lax.fori_loop(0, step.substeps, substep, state)
        for ref, values in zip(refs[-len(leaves) :], state, strict=True):
            for i, value in enumerate(values):
                ref[:, i] = value

    return kernel


def _numbers(constants_ref, leaves):
    """The vehicle's numbers as arrays of objects of its leaves' shapes."""
    parts = []
    start = 0
    for leaf in leaves:
        numbers = split(constants_ref[start + i] for i in range(leaf.size))
        parts.append(numbers.reshape(leaf.shape))
        start += leaf.size
    return parts


def _contacts(step, drone, free, sizes, around):
    """The accelerations that contacts add to those of free flight for a block of drones, components
    (3,); `sizes`: worlds, and drones in each.
    """
    position_ref, velocity_ref, pillar_ref, active_ref = around
    worlds, n = sizes
    # of a drone among those of all worlds
    number = pl.program_id(0) * DRONES + jnp.arange(DRONES)
    # the last block may be partly empty
    world = jnp.minimum(jax.lax.div(number, n), worlds - 1)
    index = jax.lax.rem(number, n)
    place = tuple(drone.position)

    def pillar_beside(k):
        foot = tuple(pillar_ref[world, 2 * k + i] for i in range(2))
        return pillar(step.arena, place, foot, active_ref[world, k] > 0.5)

    def drone_beside(k):
        row = world * n + k + (k >= index).astype(jnp.int32)  # all but oneself
        coordinates = tuple(position_ref[row, i] for i in range(3))
        return other_drone(coordinates, tuple(velocity_ref[row, i] for i in range(3)))

    # the loops first: what comes before one makes it larger for the compiler
    groups = (
        (active_ref.shape[1], pillar_beside),
        (n - 1, drone_beside),
        (1, lambda _: floor(place)),
    )
    return split(
        looped_contact_acceleration(place, tuple(drone.velocity), tuple(free), groups, step.dt)
    )
