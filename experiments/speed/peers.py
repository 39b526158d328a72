"""openjax beside its peers: `python -m experiments.speed.peers [--worlds 131072] [--json FILE]`.

Steps a second of drones (crazyflow, hyperdrone) and of a game (JaxMARL's simple_tag), and seconds
until a tumbling drone is caught and held by a learner (Brax's PPO, rl-tools' SAC) on our physics.
`pip install crazyflow hyperdrone jaxmarl brax rltools` has them; what isn't installed is left out
with a line. Every call is compiled, warmed up and repeated; the median counts.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import openjax
from experiments.speed import recovery
from openjax.command_line import run_command
from openjax.files import write_json
from openjax.interfaces.jaxmarl import PursuitMultiAgentEnv
from openjax.pursuit import action_to_command, hover_action
from openjax.runs.machine import describe_machine
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()


def rate(run, *arguments, steps: int) -> float:
    """Steps a second of a function that makes so many of them."""
    jax.block_until_ready(run(*arguments))
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(run(*arguments))
        times.append(time.perf_counter() - begin)
    return steps / float(np.median(times))


def scanned(step, steps: int):
    return jax.jit(lambda state: jax.lax.scan(lambda s, _: step(s), state, None, length=steps)[0])


def openjax_drones(options, contacts: bool = True) -> dict:
    game = openjax.make(contacts=contacts)
    state = jax.jit(jax.vmap(game.reset))(jax.random.split(jax.random.key(0), options.worlds))[1]
    command = action_to_command(jnp.broadcast_to(hover_action(VEHICLE), (3, 4)))

    def step(state):
        task = state.task
        fly = jax.vmap(lambda d, p, a: game.dynamics(VEHICLE, d, command, p, a, {}))
        drones = fly(state.drones, task.pillar_position, task.pillar_active)
        return state.replace(drones=drones), None

    number = 3 * options.worlds * options.steps
    return {"drone_steps_per_second": rate(scanned(step, options.steps), state, steps=number)}


def crazyflow_drones(options) -> dict:
    from crazyflow import Control, Dynamics, Sim

    sim = Sim(
        n_worlds=options.worlds, n_drones=3, dynamics=Dynamics.first_principles,
        control=Control("body_rate"), freq=500, device=jax.default_backend(),
    )  # fmt: skip
    sim.mjx_data = None  # for pictures and contact queries: the step doesn't use it
    hover = float(sim.data.params.mass[0]) * 9.81
    sim.body_rate_control(jnp.full((options.worlds, 3, 4), jnp.array([0.1, 0.1, 0.1, hover])))
    number = 3 * options.worlds * options.steps

    def run(data):
        return sim._step(data, n_steps=options.steps)

    return {"drone_steps_per_second": rate(run, sim.data, steps=number)}


def hyperdrone_drones(options) -> dict:
    from hyperdrone import dynamics

    device = jax.default_backend().replace("gpu", "cuda")
    sim = dynamics.Sim(3 * options.worlds, device=device)
    sim.reset()
    action = jnp.zeros((3 * options.worlds, 4))  # handed over on the device it lies on
    action = np.asarray(action) if device == "cpu" else action

    def run():
        for _ in range(options.steps):
            sim.step(action)
        sim.synchronize()

    return {"drone_steps_per_second": rate(run, steps=3 * options.worlds * options.steps)}


def game_steps(options, environment, restarts: bool = True) -> dict:
    """With `restarts` as JaxMARL steps: each draws a new start, used or not."""
    advance = environment.step if restarts else environment.step_env
    keys = jax.random.split(jax.random.key(0), options.worlds)
    state = jax.jit(jax.vmap(environment.reset))(keys)[1]
    actions = {
        agent: environment.action_space(agent).sample(keys[0]) for agent in environment.agents
    }

    def step(state):
        observed, state, reward, *_ = jax.vmap(advance, (0, 0, None))(keys, state, actions)
        return state, sum(jnp.sum(leaf) for leaf in jax.tree.leaves((observed, reward)))

    run = jax.jit(lambda state: jax.lax.scan(lambda s, _: step(s), state, None, options.steps))
    return {"environment_steps_per_second": rate(run, state, steps=options.worlds * options.steps)}


def jaxmarl_tag(options, restarts: bool = True) -> dict:
    import jaxmarl

    return game_steps(options, jaxmarl.make("MPE_simple_tag_v3"), restarts)


CASES = {
    "openjax, rigid, solid": openjax_drones,
    "openjax, rigid, free": lambda options: openjax_drones(options, contacts=False),
    "crazyflow, body rates": crazyflow_drones,
    "openjax, the game": lambda options: game_steps(options, PursuitMultiAgentEnv()),
    "JaxMARL, simple_tag": jaxmarl_tag,
    "openjax, the game without restarts": lambda options: game_steps(
        options, PursuitMultiAgentEnv(), restarts=False
    ),
    "JaxMARL, simple_tag without restarts": lambda options: jaxmarl_tag(options, restarts=False),
    "by hand, recovery": lambda options: recovery.controller(options.learning_worlds),
    "Brax's PPO, recovery": lambda options: recovery.brax_ppo(
        options.learning_steps, options.learning_worlds
    ),
    "hyperdrone, motors": hyperdrone_drones,
    "rl-tools' SAC, recovery": lambda options: recovery.rl_tools_sac(options.sac_steps),
}


def main(arguments) -> int:
    parser = argparse.ArgumentParser(prog="peers", description=__doc__.split("\n\n")[0])
    parser.add_argument("--worlds", type=int, default=131072)
    parser.add_argument("--steps", type=int, default=50, help="steps of a call")
    parser.add_argument("--learning_steps", type=int, default=10_000_000)
    parser.add_argument("--learning_worlds", type=int, default=2048)
    parser.add_argument("--sac_steps", type=int, default=20_000, help="of a single drone")
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--json", type=Path, default=Path("peers.json"))
    options = parser.parse_args(arguments)
    sizes = vars(options) | {"json": None}
    result = {"machine": describe_machine(), "sizes": sizes, "rows": {}, "left_out": {}}
    for name in options.only:
        try:
            row = result["rows"][name] = CASES[name](options)
        except Exception as reason:  # not installed, or not with this JAX or compiler
            why = f"{type(reason).__name__}: {reason}".splitlines()[0]
            result["left_out"][name] = why
            row = f"left out, {why}"
        print(f"{name}: {row}", flush=True)
        # after each, so that an interrupted study leaves some
        write_json(options.json, result)
    return 0


if __name__ == "__main__":
    run_command(main)
