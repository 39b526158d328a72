"""How fast the heuristics fly: `python -m experiments.baseline_speed [--envs 32768]`.

Environment steps per second of the whole loop: observation, method, velocity controller, physics, reward. Writes
experiments/results/baseline_speed.json and .md.
"""

import argparse

import jax

from experiments.pages import page_parser, publish, table, where
from openjax.baselines import METHODS, Heuristic
from openjax.commands.command_line import run_command
from openjax.commands.timing import time_compiled
from openjax.pursuit import Pursuit, PursuitSettings


def steps_per_second(name: str, physics: str, envs: int, steps: int) -> float | None:
    """Environment steps per second of a heuristic; None where the memory doesn't suffice."""
    environment = Pursuit(PursuitSettings(physics=physics))
    policy = Heuristic.for_environment(name, environment)
    worlds = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(0), envs))
    key = jax.random.key(1)

    def run(parameters, observation, state):
        def one(carry, _):
            observation, state = carry
            action = policy.act(parameters, observation)
            observation, state, reward, *_ = jax.vmap(environment.step, (None, 0, 0))(key, state, action)
            return (observation, state), reward.mean()

        return jax.lax.scan(one, (observation, state), None, length=steps)

    timing = time_compiled(run, (policy.parameters(), *worlds), 2.0)
    return None if timing.seconds is None else envs * steps / timing.seconds


def study(options: argparse.Namespace) -> dict:
    """All methods, both kinds of physics."""
    rows = [
        {
            "method": name,
            "physics": physics,
            "speed": steps_per_second(name, physics, options.envs, options.steps),
        }
        for name in options.methods
        for physics in ("mjx", "rigid")
    ]
    return {
        "envs": options.envs,
        "rows": rows,
    }


def report(results: dict) -> list[str]:
    """The page."""
    lines = [
        "# Speed of the heuristics",
        "",
        f"{where(results)} {results['envs']:,} worlds of three pursuers, million environment steps per second. Goal: 5 with "
        "MJX on one H200.",
        "",
    ]
    speeds = {(row["method"], row["physics"]): row["speed"] for row in results["rows"]}
    rows = [
        [
            name,
            *(
                "–" if (s := speeds[name, physics]) is None else f"{s / 1e6:.2f}"
                for physics in ("mjx", "rigid")
            ),
        ]
        for name in dict.fromkeys(row["method"] for row in results["rows"])
    ]
    return lines + table(["method", "`mjx`", "`rigid`"], rows)


def main(arguments: list[str]) -> int:
    """Measure or read it, write both files, print the page."""
    parser = page_parser(__doc__, "baseline_speed")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--envs", type=int, default=32768)
    parser.add_argument("--steps", type=int, default=50, help="control steps per call")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
