"""A training run on several devices, of one host or of many: the worlds are shared out,
all else is the same on each.

The step sees its own device's worlds and averages over all where it must
(`openjax.learning.collectives`), so that one device and many give the same result on
the same worlds, up to the order of sums.
"""

import dataclasses
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from openjax.errors import UserError
from openjax.learning import Parts, TrainCarry, TrainSettings
from openjax.learning.gradient.first_flights import FirstFlights, FirstWorlds
from openjax.learning.gradient.stage import GradientStage, StageCarry
from openjax.learning.training_step import Phases, make_phases

AXIS = "devices"
_SHARED_OUT = ("observation", "state")
"""Fields of the carry whose leading axis is the worlds."""


def can_share_out(settings: TrainSettings, number: int) -> bool:
    """True if each of `number` devices gets the same share of the worlds, of every task and of
    every minibatch.
    """
    return number == 1 or settings.num_envs % (number * _group(settings)) == 0


def check_devices(settings: TrainSettings, number: int) -> None:
    """Raise UserError unless the worlds can be shared out.

    Raises:
      UserError: they can't, with the next number of worlds that could, and the numbers
      of devices that can.
    """
    if not can_share_out(settings, number):
        unit = number * _group(settings)
        possible = -(-settings.num_envs // unit) * unit  # rounded up
        fewer = [n for n in range(1, number) if can_share_out(settings, n)]
        raise UserError(
            f"num_envs {settings.num_envs} can't be shared out to {number} devices; {possible} "
            f"could, or --devices {' or '.join(map(str, fewer))}"
        )


def _group(settings):
    """Worlds that can't be parted."""
    return int(np.lcm.reduce([settings.world_unit, *settings.minibatches.values()]))


def check_memory(settings: TrainSettings, number: int) -> None:
    """Raise UserError unless the worlds, a rollout and the archive fit into `number` devices.

    Raises:
      UserError: it doesn't; said before anything is compiled.
    """
    game = settings.environment
    # places of pursuers and evader; of each pillar two coordinates and whether it's
    # there
    tasks = 3 * game.num_pursuers + 3 + 3 * game.max_pillars
    observation_size = game.self_size + game.privileged_size + 5 * game.observed_pillars
    history = game.history_length * game.history_spacing * game.frame_size
    per_world = tasks + history + settings.rollout_length * game.num_pursuers * observation_size
    shared_out = settings.num_envs * per_world / number
    validation = 2 * settings.validation_episodes * (tasks + history)
    # four bytes a number; the archive and the validation are the same on each device
    memory_needed = 4 * (shared_out + settings.generator.capacity * tasks + validation)
    if memory_needed > (memory := _memory()):
        raise UserError(
            f"{settings.num_envs} worlds of {settings.rollout_length} steps need at least "
            f"{memory_needed / 2**30:.0f} GiB on each of {number} devices, which has "
            f"{memory / 2**30:.0f}; fewer --num_envs need less"
        )


def _memory():
    """Bytes of one device; for a CPU those of the whole machine."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return (device.memory_stats() or {}).get("bytes_limit", float("inf"))


def carry_shardings(number: int) -> TrainCarry | jax.sharding.Sharding:
    """The shardings of a carry's leaves, as a prefix of its tree."""
    same = everywhere(number)
    if number == 1:
        return same
    return _carry_of(NamedSharding(_mesh(number), PartitionSpec(AXIS)), same)


def everywhere(number: int) -> jax.sharding.Sharding:
    """The sharding of an array that every device has whole."""
    if number == 1:
        return jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return NamedSharding(_mesh(number), PartitionSpec())


def own_copy(tree: Any) -> Any:
    """Arrays that every device has whole, on this process' first device."""
    device = jax.local_devices()[0]
    return jax.tree.map(lambda leaf: jax.device_put(leaf.addressable_data(0), device), tree)


def make_device_step(
    settings: TrainSettings, parts: Parts, number: int, part: Callable = Phases.__call__
) -> Callable:
    """The training step `carry -> (carry, metrics)`, or a part of it, a method of
    `Phases`, on `number` devices, not yet compiled.
    """
    phases = make_phases(settings, parts, axis=None if number == 1 else AXIS)

    # a function by its name, as the compiler's cache knows programs by theirs
    def step(carry):
        return part(phases, carry)

    if number == 1:
        return step
    carry = _carry_of(PartitionSpec(AXIS), PartitionSpec())
    return _shared_out(number, step, (carry,), (carry, PartitionSpec()))


def make_device_first_flights(
    flights: FirstFlights, together: int, number: int
) -> tuple[Callable, Callable, Any]:
    """The stage's `begin`, and `together` of its updates (`GradientStage.several`), on
    `number` devices, not yet compiled; where the leaves of their carry lie.
    """
    if number == 1:
        stage = GradientStage(flights)
        return stage.begin, stage.several(together), None
    stage = GradientStage(dataclasses.replace(flights, axis=AXIS))
    same = PartitionSpec()
    carry = StageCarry(same, FirstWorlds(PartitionSpec(AXIS), same))
    begin = _shared_out(number, stage.begin, (same, same), carry)
    some = _shared_out(number, stage.several(together), (carry, same, same, same), (carry, same))
    mesh = _mesh(number)
    at = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        carry,
        is_leaf=lambda leaf: isinstance(leaf, PartitionSpec),
    )
    return begin, some, at


def compiler_options(number: int, brief: bool = False) -> dict:
    """For programs on `number` devices; a `brief` one runs for seconds alone.

    On a GPU XLA tries each matrix product in dozens of ways. That is half of its work,
    and where it doesn't, a training step takes three times as long. A brief program
    takes those of cuBLAS as they are.
    """
    backend = jax.default_backend()
    if backend == "gpu" and brief:
        return {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
    if backend == "cpu" and number > 1:
        # devices are cores here, and threads would get in their way
        return {"xla_cpu_multi_thread_eigen": False}
    return {}


def _shared_out(number, function, takes, gives):
    """A function of each device's share as one of the whole, as the specifications have
    it.
    """
    # gradients are averaged in it; with the check on, they'd be summed before that
    return jax.shard_map(
        function, mesh=_mesh(number), in_specs=takes, out_specs=gives, check_vma=False
    )


def _mesh(number):
    return Mesh(np.asarray(jax.devices()[:number]), (AXIS,))


def _carry_of(shared_out, same):
    fields = TrainCarry.__dataclass_fields__
    return TrainCarry(**{name: shared_out if name in _SHARED_OUT else same for name in fields})
