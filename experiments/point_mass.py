"""How much of a method's collisions is the vehicle's: `python -m experiments.point_mass [--tasks 512]`.

The methods that put out a velocity, flown as what they take a drone for: a point whose velocity is the commanded one at once,
or follows it with a lag. Beside them the vehicle behind its velocity controller, with the methods asked what they would do here
and now, and where all will be after the vehicle's response; on the same tasks, which are such as the trainers draw. Writes
experiments/results/point_mass.json and .md.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baseline_search import training_tasks
from experiments.pages import page_parser, publish, table, where
from experiments.worlds.game import flown_pursuit, remember
from openjax.baselines import METHODS, DacoopPolicy
from openjax.baselines.surroundings import surroundings
from openjax.commands.command_line import run_command
from openjax.learning import make_evaluate
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings
from openjax.store.policies import LoadedPolicy, load_policy

LAGS = (0.0, 0.1, 0.2)
"""Time constants (s) of the points."""
POLICIES = (*METHODS, "dacoop_seed_0")


def without_response(loaded: LoadedPolicy) -> LoadedPolicy:
    """The method asked about here and now."""
    craft = dataclasses.replace(loaded.policy.craft, response=0.0)
    return dataclasses.replace(loaded, policy=dataclasses.replace(loaded.policy, craft=craft))


def velocity_of(loaded: LoadedPolicy):
    """`velocity(observation)` (..., N, 3) in m/s that a method puts out."""
    policy, actor = loaded.policy, loaded.parameters.actor
    if isinstance(policy, DacoopPolicy):
        return lambda seen: policy.desired(policy.distribution(actor, seen, None)[0], seen)
    return lambda seen: METHODS[policy.name].rule(policy.craft, actor, surroundings(policy.craft, seen))


def as_points(loaded: LoadedPolicy, settings: PursuitSettings, tasks, lags: jax.Array) -> EpisodeStatistics:
    """One episode per task and lag (leading axis) of points."""
    game = flown_pursuit(settings)
    velocity, action = velocity_of(loaded), jnp.zeros((settings.num_pursuers, 4))

    def step(state, desired, lag):
        drones = state.drones
        share = jnp.minimum(1.0, settings.time_step / jnp.maximum(lag, 1e-6))
        flown = {"quaternion": drones.quaternion}
        flown["velocity"] = drones.velocity + share * (desired - drones.velocity)
        flown["position"] = drones.position + settings.time_step * flown["velocity"]
        state = state.replace(drones=remember(drones, flown, flown))
        observation, state, *_ = game.step(None, state, action)
        return observation, state

    @jax.jit
    def fly(tasks, lags):
        def one(carry, _):
            observation, state = carry
            return jax.vmap(step)(state, velocity(observation), lags), None

        keys = jax.random.split(jax.random.key(0), lags.shape[0])
        start = jax.vmap(game.reset_to)(keys, tasks)
        (_, state), _ = jax.lax.scan(one, start, length=settings.episode_length)
        return state.statistics

    return fly(tasks, lags)


def means(counted: EpisodeStatistics, groups: int) -> list[list[float]]:
    """Capture rate, capture step, collision rate and crash rate of each group of episodes."""
    each = (counted.captured, counted.capture_step, counted.collision_rate, counted.crashed)
    return np.stack(
        [np.asarray(value, float).reshape(groups, -1).mean(axis=1) for value in each], axis=-1
    ).tolist()


def study(options: argparse.Namespace) -> dict:
    """All methods."""
    tasks = training_tasks(PursuitSettings(), jax.random.key(10), options.tasks)
    repeated = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * len(LAGS)), tasks)
    lags, rows = jnp.repeat(jnp.array(LAGS), options.tasks), {}
    for name in POLICIES:
        loaded = load_policy(name)
        settings = dataclasses.replace(
            loaded.settings.environment, physics="rigid", start_attitude="level", speed_limit="clamp"
        )
        environment = Pursuit(settings)
        loaded = loaded.in_game(environment)
        now = without_response(loaded)
        rows[name] = means(as_points(now, settings, repeated, lags), len(LAGS))
        for each in (now, loaded):
            evaluate = jax.jit(make_evaluate(environment, each.policy))
            rows[name] += means(evaluate(each.parameters, tasks, jax.random.key(0)).statistics, 1)
        print(name, rows[name], flush=True)
    return {
        "tasks": options.tasks,
        "rows": rows,
    }


def report(results: dict) -> list[str]:
    """The page."""
    heads = [*(f"point, lag {lag:g} s" for lag in LAGS), "vehicle, asked about now", "vehicle"]
    return [
        "# The methods that put out a velocity, as points and as vehicles",
        "",
        f"{where(results)} {results['tasks']} training tasks, speed clamp, level starts. Capture rate / capture step / "
        "collision rate / crash rate.",
        "",
        *table(
            ["method", *heads],
            [
                [name, *(f"{a:.3f} / {b:.0f} / {c:.4f} / {d:.3f}" for a, b, c, d in row)]
                for name, row in results["rows"].items()
            ],
        ),
    ]


def main(arguments: list[str]) -> int:
    """Measure or read it, write both files, print the page."""
    parser = page_parser(__doc__, "point_mass")
    parser.add_argument("--tasks", type=int, default=512)
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
