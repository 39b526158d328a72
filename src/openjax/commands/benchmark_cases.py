"""The cases of `openjax benchmark`: physics, environment, rollout and the training step, each as
one function.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.cluster.devices import carry_shardings, check_devices, make_device_step
from openjax.commands.options import BenchmarkCommand
from openjax.errors import UserError
from openjax.evaluation.validation import uniform_tasks
from openjax.learning import TrainSettings, build, make_start, training_step
from openjax.learning.rollout import ExplorationNoise, Players, collect
from openjax.pursuit import Pursuit, hover_action
from openjax.pursuit.environment import action_to_command
from openjax.store.leaves import place
from openjax.vehicle import hover_state, load_vehicle, make_drones_step


class Workload(NamedTuple):
    """A case to be timed."""

    name: str
    num_envs: int
    steps: int
    """Control steps of a call."""
    function: Callable
    arguments: tuple


def cases(command: BenchmarkCommand, part: str, num_envs: int) -> Iterator[Workload]:
    """The cases of a part, made one at a time: together they wouldn't fit into memory."""
    settings = command.settings
    steps = command.steps
    if part == "training":
        for number in command.devices:
            fitting = fitting_settings(settings, num_envs, number)
            for name, function, arguments in _training(fitting, number):
                yield Workload(name, fitting.num_envs, fitting.rollout_length, function, arguments)
        return
    if part == "rollout":
        function, arguments = _rollout(settings, num_envs, steps)
    elif part == "environment":
        function, arguments = _environment(settings, num_envs, steps)
    else:
        function, arguments = _physics(part, settings, num_envs, steps)
    yield Workload(part, num_envs, steps, function, arguments)


def _training(settings, devices):
    """The whole training step, then, of one device, the programs that it is made of:
    (name, function, its arguments).
    """
    # what is timed begins where a run does; later updates take as long
    carry = make_start(settings)(jax.random.key(0))
    if devices > 1:
        step = make_device_step(settings, build(settings), devices)
        yield (f"training, {devices} devices", step, (place(carry, carry_shardings(devices)),))
        return
    phases = training_step.make_phases(settings)
    yield "training", training_step.make_training_step(settings), (carry,)
    yield "- fly", phases.fly, (carry,)
    # zeros: learning from them takes as long as from anything
    rollout = jax.eval_shape(phases.fly, carry)[1]
    rollout = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), rollout)
    for learn in phases.learn:
        yield f"- {learn.__name__}", learn, (carry, rollout)
    yield "- renew", phases.renew, (carry,)


def fitting_settings(settings: TrainSettings, num_envs: int, devices: int = 1) -> TrainSettings:
    """The settings with the nearest number of environments from above that they and so
    many devices allow.
    """
    for number in range(num_envs, num_envs + 10_000):
        try:
            fitting = dataclasses.replace(settings, num_envs=number)
            check_devices(fitting, devices)
            return fitting
        except UserError:
            continue
    raise UserError(
        f"training_envs {num_envs}: neither this nor any larger number fits the settings"
    )


def _physics(part, settings, num_envs, steps):
    """Drones of each world hover among a task's pillars and turn slowly."""
    game = settings.environment
    vehicle = load_vehicle()
    drones_step = make_drones_step(
        physics=part.removesuffix("_free"),
        dt=game.time_step,
        substeps=game.substeps,
        contacts=not part.endswith("_free"),
    )
    tasks = uniform_tasks(game, num_envs, game.max_pillars)
    drones = jax.jit(jax.vmap(lambda task: hover_state(vehicle, task.pursuer_position)))(tasks)
    command = action_to_command(jnp.broadcast_to(hover_action(vehicle), (game.num_pursuers, 4)))
    command = command.at[:, 1:].add(0.1)

    def run(drones, tasks):
        def one(drones, _):
            step = jax.vmap(lambda d, p, a: drones_step(vehicle, d, command, p, a, {}))
            return step(drones, tasks.pillar_position, tasks.pillar_active), None

        return jax.lax.scan(one, drones, None, length=steps)[0]

    return run, (drones, tasks)


def _environment(settings, num_envs, steps):
    environment = Pursuit(settings.environment)
    state = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(0), num_envs))[1]
    key = jax.random.key(1)
    action = 0.1 * jax.random.normal(key, (num_envs, settings.environment.num_pursuers, 4))
    action = jnp.tanh(action + hover_action(environment.vehicle))

    def run(state, action):
        def one(state, _):
            observation, state, reward, *_ = jax.vmap(environment.step, (None, 0, 0))(
                key, state, action
            )
            # Observation and reward are used, else the compiler would leave them out.
            total = sum(jnp.sum(leaf) for leaf in jax.tree.leaves(observation)) + jnp.sum(reward)
            return state, total

        return jax.lax.scan(one, state, None, length=steps)

    return run, (state, action)


def _rollout(settings, num_envs, steps):
    parts = build(settings)
    environment = parts.environment
    keys = jax.random.split(jax.random.key(0), num_envs)
    observation, state = jax.jit(jax.vmap(environment.reset))(keys)
    first = jax.tree.map(lambda leaf: leaf[0], observation)
    parameters = jax.jit(parts.policy.init)(jax.random.key(1), first)

    def run(parameters, observation, state, key):
        shape = (steps, num_envs, settings.environment.num_pursuers, parts.policy.sample_size)
        players = Players(environment, parts.policy, parameters)
        return collect(
            players, (observation, state), ExplorationNoise(jax.random.normal(key, shape))
        )

    return run, (parameters, observation, state, jax.random.key(2))


@dataclasses.dataclass(frozen=True)
class Timing:
    """One compiled function, timed."""

    compile_seconds: float
    """Tracing and compilation; a persistent compilation cache shortens it."""
    seconds: float | None
    """Median time of one call; None where it ran out of memory."""
    slowest: float | None
    """Of all calls."""
    calls: int
    memory: int | None
    """Bytes for arguments, results and temporaries of one call, by the compiler's account."""


def time_compiled(case: Workload, min_seconds: float) -> Timing:
    """Compile a case's function, run it once to warm up, then time three calls or more, for at
    least `min_seconds`.

    Each call gets the same arguments and is waited for, so that all calls do the same work.
    """
    start = time.perf_counter()
    executable = jax.jit(case.function).lower(*case.arguments).compile()
    compile_seconds = time.perf_counter() - start
    memory = _memory(executable)

    program = functools.partial(executable, *case.arguments)

    def call():
        start = time.perf_counter()
        jax.block_until_ready(program())
        return time.perf_counter() - start

    times: list[float] = []
    try:
        call()  # the first one also loads the program
        while sum(times) < min_seconds or len(times) < 3:
            times.append(call())
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return Timing(compile_seconds, None, None, 0, memory)
    return Timing(compile_seconds, float(np.median(times)), max(times), len(times), memory)


def _memory(executable):
    """See `Timing.memory`; None where the compiler doesn't tell."""
    analysis = executable.memory_analysis()
    if analysis is None:
        return None
    outputs = analysis.output_size_in_bytes + analysis.temp_size_in_bytes
    # results that are written into an argument's place take no more
    return int(analysis.argument_size_in_bytes + outputs - analysis.alias_size_in_bytes)
