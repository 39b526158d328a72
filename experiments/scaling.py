"""Scaling of the whole training step over the devices of a host: `python -m experiments.scaling [--commit HASH]`.

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

from experiments import pages
from openjax.cluster.devices import carry_shardings, check_devices, everywhere, make_device_step
from openjax.commands.command_line import parse, peek, run_command
from openjax.commands.machine import describe_machine
from openjax.commands.training_loop import guarded
from openjax.errors import UserError
from openjax.learning import TrainCarry, TrainSettings, build, init_carry, preset
from openjax.store.leaves import place
from openjax.store.settings_files import write_json

PROGRAM = "python -m experiments.scaling"
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
    json: Path = Path(__file__).parent / "results" / "scaling.json"
    """File of the results."""
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


def table(rows: Sequence[dict]) -> list[str]:
    """The rows as a Markdown table."""
    heads = ["what grows", "devices", "worlds", "minibatches", "training step [s]", "env steps/s"]
    one = rows[0]["env_steps_per_second"]
    body = []
    for row in rows:
        gain = row["env_steps_per_second"] / one
        sizes = [row["kind"], str(row["devices"]), f"{row['num_envs']:,}", str(row["minibatches"])]
        speeds = [f"{row['seconds']:.3f}", f"{row['env_steps_per_second']:,.0f}"]
        body.append([*sizes, *speeds, f"{gain:.2f}", f"{gain / row['devices']:.2f}"])
    return pages.table([*heads, "against one device", "per device"], body)


def report(facts: dict, settings: TrainSettings, rows: Sequence[dict], left_out: Sequence[str]) -> str:
    """The Markdown file beside the results."""
    machine = facts["machine"]
    lines = [
        "# Scaling of the training step over the devices of a host",
        "",
        f"`{facts['command']}`: {machine['device']}, JAX {machine['versions']['jax']}, commit {machine['commit']}, "
        f"{machine['date'][:10]}.",
        f"Physics {settings.environment.physics}, {settings.mappo.epochs} epochs, rollouts of "
        f"{settings.rollout_length} steps, networks in {settings.network.compute_type}. Median of the timed steps, "
        "each waited for; compilation apart.",
        "`weak`: every device has the worlds of one alone, minibatches grow; `weak_batches`: there are more "
        "minibatches instead; `strong`: the worlds of one device, shared out.",
        "",
        *table(rows),
    ]
    if left_out:
        lines += ["", "Left out:", "", *(f"* {reason}" for reason in left_out)]
    return "\n".join(lines) + "\n"


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
    machine = describe_machine()
    if command.commit is not None:
        machine |= {"commit": command.commit, "commit_clean": None}
    facts = {"command": pages.typed_command(), "machine": machine}
    print(f"{machine['device']} × {available}: compiling {len(found)} programs ...", flush=True)
    start = init_carry(command.settings, jax.random.key(0))
    programs = compiled_cases(found, start)
    print(f"compiled after {time.monotonic() - began:.0f} s", flush=True)
    rows = []
    for case, (program, trace, compile_) in zip(found, programs, strict=True):
        if rows and time.monotonic() - began > command.seconds:
            left_out.append(f"{case.kind} on {case.devices} devices: {command.seconds:.0f} s were over")
            continue
        rows.append(row_of(case, measure(case, program, start, command.calls), trace, compile_))
        print(table(rows[:1] + rows[-1:])[-1], flush=True)
        # After each, so that what was measured stays if the rest fails.
        write_json(command.json, {**facts, "settings": command.settings, "rows": rows, "left_out": left_out})
    write_json(command.json, {**facts, "settings": command.settings, "rows": rows, "left_out": left_out})
    text = report(facts, command.settings, rows, left_out)
    command.json.with_suffix(".md").write_text(text, encoding="utf-8")
    print(f"written to {command.json} after {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
