"""Scaling of the whole training step over the devices of a host: `python -m experiments.speed.scaling [--commit HASH]`.

weak          as many worlds on every device as one has alone, minibatches as many and so larger: how one would train
weak_batches  the same worlds, but as many more minibatches: each is as large as on one device
strong        the worlds of one device, shared out

All programs are compiled first, side by side; then each runs once to warm up and a few times to be timed, every time
waited for. Writes experiments/results/scaling.json and, beside it, a table (.md).
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.table import RESULTS, Page, Table, facts, write_page
from openjax.cluster.devices import carry_shardings, check_devices, everywhere, make_device_step
from openjax.commands.command_line import parse, peek, run_command
from openjax.commands.training_loop import guarded
from openjax.errors import UserError
from openjax.learning import TrainCarry, TrainSettings, build, init_carry, preset
from openjax.store.leaves import place
from openjax.store.settings_files import to_plain, write_json

PROGRAM = "python -m experiments.speed.scaling"
Kind = Literal["weak", "weak_batches", "strong"]


@dataclasses.dataclass(frozen=True)
class ScalingCommand:
    """Measure environment steps per second of the training step on 1, 2, 4, ... devices of this host."""

    preset: str | None = None
    """quick or paper; by default what fits the machine."""
    devices: tuple[int, ...] = ()
    """Numbers of devices; by default 1, 2, 4, ... up to all."""
    kinds: tuple[Kind, ...] = ("weak", "strong")
    """What grows with the devices."""
    calls: int = 4
    """Timed training steps of each."""
    seconds: float = 90.0
    """Time after which no further measurement is begun."""
    out: Path = RESULTS / "scaling"
    """Results are written to this path with .json and .md."""
    commit: str | None = None
    """Commit that is measured, where the source tree can't tell."""
    settings: Annotated[tyro.conf.FlagConversionOff[TrainSettings], tyro.conf.arg(name="")] = (
        dataclasses.field(default_factory=TrainSettings)
    )


@dataclasses.dataclass(frozen=True)
class Case:
    """One measurement."""

    kind: str
    devices: int
    settings: TrainSettings


def cases(
    settings: TrainSettings, devices: Sequence[int], kinds: Sequence[str]
) -> tuple[list[Case], list[str]]:
    """What to measure, one device (which all kinds share) first; and why some can't be.

    Raises:
      UserError: not even the settings themselves fit one device.
    """
    found, left_out = [Case("one", 1, settings)], []
    for kind in kinds:
        for number in sorted(set(devices) - {1}):
            try:
                case = Case(kind, number, _grown(settings, kind, number))
                check_devices(case.settings, number)
                found.append(case)
            except UserError as error:
                left_out.append(f"{kind} on {number} devices: {error}")
    return found, left_out


def _grown(settings, kind, number):
    mappo = settings.mappo
    if kind == "weak_batches":
        mappo = dataclasses.replace(mappo, minibatches=mappo.minibatches * number)
    worlds = settings.num_envs * (1 if kind == "strong" else number)
    return dataclasses.replace(settings, num_envs=worlds, mappo=mappo)


def repeated(carry: TrainCarry, times: int) -> TrainCarry:
    """A carry of `times` as many worlds: copies, which their own noise and tasks soon tell apart."""

    def tile(tree):
        return jax.tree.map(lambda leaf: jnp.concatenate([leaf] * times), tree)

    return carry.replace(observation=tile(carry.observation), state=tile(carry.state))


def compiled_cases(found: Sequence[Case], start: TrainCarry) -> list[tuple[Any, float, float]]:
    """(program, seconds of tracing, seconds of compilation) of each; the compilations run side by side."""
    traced = []
    for case in found:
        begin = time.perf_counter()
        times = case.settings.num_envs // start.state.step.shape[0]
        environment = build(case.settings).environment
        step = guarded(
            make_device_step(case.settings, environment, case.devices),
            carry_shardings(case.devices),
            everywhere(case.devices),
        )
        shapes = jax.eval_shape(lambda carry, times=times: repeated(carry, times), start)
        at = jax.tree.broadcast(carry_shardings(case.devices), shapes)
        shapes = jax.tree.map(lambda s, at: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=at), shapes, at)
        traced.append((step.lower(shapes), time.perf_counter() - begin))

    def compiled(entry):
        begin = time.perf_counter()
        return entry[0].compile(), entry[1], time.perf_counter() - begin

    with ThreadPoolExecutor(len(traced)) as pool:
        return list(pool.map(compiled, traced))


def measure(case: Case, program: Any, start: TrainCarry, calls: int) -> list[float]:
    """Seconds of each timed call, after one to warm up; the carry goes from call to call as in a run."""
    carry = repeated(start, case.settings.num_envs // start.state.step.shape[0])
    # A copy at the least: the program takes its carry's memory, and other cases start from the same.
    carry = place(jax.tree.map(jnp.copy, carry), carry_shardings(case.devices))
    times = []
    for _ in range(calls + 1):
        begin = time.perf_counter()
        carry, _, broken = jax.block_until_ready(program(carry))
        times.append(time.perf_counter() - begin)
    if np.any(broken):
        raise UserError(f"{case.kind} on {case.devices} devices: the training step gave a NaN")
    return times[1:]


def row_of(case: Case, times: Sequence[float], trace: float, compile_: float) -> dict:
    """One measurement; an environment step moves one world by one control step, all its drones."""
    median = float(np.median(times))
    return {
        "kind": case.kind,
        "devices": case.devices,
        "num_envs": case.settings.num_envs,
        "minibatches": case.settings.mappo.minibatches,
        "seconds": median,
        "slowest": max(times),
        "calls": len(times),
        "env_steps_per_second": case.settings.steps_per_update / median,
        "trace_seconds": trace,
        "compile_seconds": compile_,
    }


def page(results: dict) -> Page:
    """A row per measurement."""
    one = results["rows"][0]["env_steps_per_second"]
    columns = {
        "what grows": "kind",
        "devices": "devices",
        "worlds": "num_envs:,",
        "minibatches": "minibatches",
        "training step [s]": "seconds:.3f",
        "env steps/s": "env_steps_per_second:,.0f",
        "against one device": lambda row: f"{row['env_steps_per_second'] / one:.2f}",
        "per device": lambda row: f"{row['env_steps_per_second'] / one / row['devices']:.2f}",
    }
    settings = results["settings"]
    left_out = [f"Left out: {'; '.join(results['left_out'])}."] if results["left_out"] else []
    return Page(
        "Scaling of the training step over the devices of a host",
        f"Physics {settings['environment']['physics']}, {settings['mappo']['epochs']} epochs, rollouts of "
        f"{settings['rollout_length']} steps, networks in {settings['network']['compute_type']}. Median of the timed "
        "steps, each waited for; compilation apart. `weak`: every device has the worlds of one alone, minibatches grow; "
        "`weak_batches`: there are more minibatches instead; `strong`: the worlds of one device, shared out.",
        (Table(columns, results["rows"]), *left_out),
    )


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    began = time.monotonic()
    fitting = "quick" if jax.default_backend() == "cpu" else "paper"
    default = ScalingCommand(settings=preset(peek(arguments, "preset") or fitting))
    command = parse(ScalingCommand, default, arguments, PROGRAM)
    available = len(jax.devices())
    devices = command.devices or tuple(2**i for i in range(available.bit_length()))
    if not all(1 <= number <= available for number in devices) or command.calls < 1:
        raise UserError(f"--devices takes numbers from 1 to the {available} that are here, --calls from 1 on")
    found, left_out = cases(command.settings, devices, command.kinds)
    about = facts(command.commit)
    print(f"{about['machine']['device']} × {available}: compiling {len(found)} programs ...", flush=True)
    start = init_carry(command.settings, jax.random.key(0))
    programs = compiled_cases(found, start)
    print(f"compiled after {time.monotonic() - began:.0f} s", flush=True)
    results = to_plain({**about, "settings": command.settings, "rows": [], "left_out": left_out})
    for case, (program, trace, compile_) in zip(found, programs, strict=True):
        if results["rows"] and time.monotonic() - began > command.seconds:
            results["left_out"].append(
                f"{case.kind} on {case.devices} devices: {command.seconds:.0f} s were over"
            )
            continue
        row = row_of(case, measure(case, program, start, command.calls), trace, compile_)
        results["rows"].append(row)
        print(f"{case.kind}, {case.devices} devices: {row['seconds']:.3f} s", flush=True)
        write_json(command.out.with_suffix(".json"), results)  # what was measured stays if the rest fails
    write_json(command.out.with_suffix(".json"), results)
    write_page(command.out, page, results)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
