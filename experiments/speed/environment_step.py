"""Seconds that `environment.step` takes to compile, and its speed: `python -m
experiments.speed.environment_step [--source SRC ...]`.

Each SRC is a folder that holds a package `openjax`, timed in a process of its own and in turns, so
that two versions are compared on one machine: `git archive COMMIT src assets | tar -x -C DIR`. The
step is vmapped and runs in a scan, as in anybody's program. Prints a line of JSON for each.

With `--masked` each source is timed a second time with masks: a game of teams of any size, in which
all slots are in use, and the evader's speed and the capture radius are the task's. With
`--restarts` it is timed a second time as JaxMARL's users step it: an episode that ends starts anew,
and the worlds are spread evenly over an episode.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
WAYS = ("plain", "masked", "restarts")
REPEATS = 3
"""Runs after the first, of which the fastest counts."""


def measure(worlds: int, steps: int, contacts: bool, way: str) -> dict:
    """In this process: seconds to compile, and drone steps a second."""
    import jax

    import openjax

    jax.config.update("jax_enable_compilation_cache", False)
    teams = {"team_sizes": (3,), "evader_speeds": (0.8, 2.0), "capture_radii": (0.2, 0.4)}
    changes = teams if way == "masked" else {}
    environment = openjax.make(physics="rigid", contacts=contacts, **changes)
    key = jax.random.key(0)
    keys = jax.random.split(key, worlds)
    state = jax.jit(jax.vmap(environment.reset))(keys)[1]
    pursuers = environment.settings.num_pursuers
    action = 0.1 * jax.random.normal(key, (worlds, pursuers, 4))
    if way == "restarts":
        length = environment.settings.episode_length
        state = state.replace(step=jax.numpy.arange(worlds, dtype=jax.numpy.int32) % length)
        advance = restarting(environment, keys, action)
    else:
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))

        def advance(state):
            return step(key, state, action)[1]

    def fly(state):
        return jax.lax.scan(lambda s, _: (advance(s), None), state, length=steps)[0]

    began = time.perf_counter()
    program = jax.jit(fly).lower(state).compile()
    compiling = time.perf_counter() - began
    _, *seconds = [timed(program, state) for _ in range(1 + REPEATS)]
    return {
        "device": jax.devices()[0].device_kind,
        "way": way,
        "compile_seconds": compiling,
        "environment_steps_a_second": worlds * steps / min(seconds),
        "drone_steps_a_second": worlds * pursuers * steps / min(seconds),
    }


def timed(program, state) -> float:
    """Seconds of a call."""
    import jax

    began = time.perf_counter()
    jax.block_until_ready(program(state))
    return time.perf_counter() - began


def restarting(environment, keys, action):
    """The step of all worlds as JaxMARL steps them, for `keys` and `action` by world."""
    import jax

    from openjax.interfaces.jaxmarl import PursuitMultiAgentEnv

    game = PursuitMultiAgentEnv(environment)
    actions = {agent: action[:, place] for place, agent in enumerate(game.agents)}

    def advance(state):
        observed, state, rewards, *_ = jax.vmap(game.step)(keys, state, actions)
        # what nobody reads would not be worked out
        total = sum(leaf.sum() for leaf in jax.tree.leaves((observed, rewards)))
        position = state.evader_position.at[0, 0].add(1e-9 * total)
        return state.replace(evader_position=position)

    return advance


def main(arguments: list[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", nargs="+", default=[str(ROOT / "src")])
    parser.add_argument("--worlds", type=int, default=131_072)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--free", action="store_true", help="without contacts")
    parser.add_argument("--masked", action="store_true", help="with masks, too")
    parser.add_argument("--restarts", action="store_true", help="with restarts, too")
    parser.add_argument("--here", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.here:
        print(json.dumps(measure(options.worlds, options.steps, not options.free, options.here)))
        return
    ways = [way for way in WAYS if way == "plain" or getattr(options, way)]
    for _ in range(2):  # in turns: a machine warms up
        for source in options.source:
            environment = os.environ | {"PYTHONPATH": str(Path(source).resolve())}
            print(source, flush=True)
            for way in ways:
                command = [sys.executable, __file__, *arguments, "--here", way]
                subprocess.run(command, env=environment, check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
