"""Where one of a team falls out, who gets away: `python -m experiments.evaders.fallen
--json FILE`.

Flies a team of each size against scripted evaders, by default the held-out ones, on
uniform tasks, whole and with one pursuer gone after two seconds. Says how many are
caught by the end of each second, by which evader, and how fast the pursuers fly where
it gets away. With `--clock S` the time that pursuers observe stands still after S
seconds: who knows the time may risk less as it passes.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from openjax.commands.catch_map import draw_task, map_game
from openjax.commands.options import MapCommand
from openjax.evaluation.episodes import make_evaluate, wilson
from openjax.files import write_json
from openjax.pursuit import Observation, Pursuit, PursuitSettings, PursuitState, observe
from openjax.pursuit.evaders.kinds import HELD_OUT
from openjax.runs.machine import describe_machine
from openjax.store.policies import load_policy
from openjax.vehicle import DroneState


@dataclass(frozen=True)
class StoppedClock:
    """What pursuers observe, at a time that stands still after so many steps."""

    steps: int

    def __call__(
        self, settings: PursuitSettings, state: PursuitState, seen_drones: DroneState
    ) -> Observation:
        """The game's own observation with another time."""
        late = jnp.maximum(state.step - self.steps, 0)
        past = jnp.maximum(state.frames[..., 0] - late / settings.episode_length, 0.0)
        shown = state.replace(step=state.step - late, frames=state.frames.at[..., 0].set(past))
        # who has fallen out stays away, whatever the time that is shown
        if state.gone_after is not None:
            shown = shown.replace(gone_after=state.gone_after - late)
        return observe(settings, shown, seen_drones)


def fly(options: argparse.Namespace, size: int, fall_outs: float) -> dict:
    """Figures of one size of team."""
    loaded = load_policy(options.policy)
    command = MapCommand(
        options.policy,
        sizes=(size,),
        scenario="uniform",
        fall_outs=fall_outs,
        evaders=tuple(options.evaders),
    )
    game = map_game(command, loaded.settings.environment)
    observer = None
    if options.clock is not None:
        observer = StoppedClock(round(options.clock / game.time_step))
    environment = Pursuit(game, observer=observer)
    loaded = loaded.in_game(environment)
    evaluate = make_evaluate(environment, loaded.policy, trajectory=True)
    kinds = jnp.arange(options.episodes) % len(options.evaders)

    @jax.jit
    def all_episodes(key):
        cell = jnp.array([size, options.speed_ratio, options.radius], jnp.float32)
        keys = jax.random.split(key, options.episodes)
        tasks = jax.vmap(lambda key: draw_task(game, command, key, cell))(keys)
        evaluation, record = evaluate(loaded.parameters, tasks.replace(evader=kinds), key)
        return evaluation.statistics, record.pursuers

    statistics, path = jax.tree.map(np.asarray, all_episodes(jax.random.key(options.seed)))
    return {
        "pursuers": size,
        "fall_outs": fall_outs,
        "clock": options.clock,
        **figures(game, np.asarray(kinds), statistics, path),
    }


def figures(game: PursuitSettings, kinds: np.ndarray, statistics, path: np.ndarray) -> dict:
    """Captures of episodes (B,) by second and by evader, crashes, and by second the
    mean speed (m/s) of the pursuers at (B, T, N, 3) m that are there, in episodes whose
    evader is free throughout.
    """
    caught = statistics.captured
    second = round(1.0 / game.time_step)
    ends = range(second, game.episode_length + 1, second)
    speed = np.linalg.norm(np.diff(path, axis=1), axis=-1) / game.time_step
    # who is parked, or on the way there
    speed = np.where(np.abs(path[:, 1:, :, 0]) > 2 * game.arena_radius, np.nan, speed)
    free = speed[~caught]
    return {
        "episodes": len(caught),
        "capture_rate": float(caught.mean()),
        "interval": list(wilson(int(caught.sum()), len(caught))),
        "crash_rate": float(statistics.crashed.mean()),
        "caught_by_second": [
            float((caught & (statistics.capture_step <= end)).mean()) for end in ends
        ],
        "by_evader": {
            name: float(caught[kinds == place].mean()) for place, name in enumerate(game.evaders)
        },
        "speed_by_second": [
            round(float(np.nanmean(free[:, end - second : end - 1])), 3)
            if np.isfinite(free[:, end - second : end - 1]).any()
            else None
            for end in ends
        ],
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", default="teams")
    parser.add_argument("--sizes", nargs="+", type=int, default=[2, 3, 4])
    parser.add_argument("--evaders", nargs="+", default=HELD_OUT)
    parser.add_argument("--episodes", type=int, default=1200)
    parser.add_argument("--clock", type=float, help="seconds after which the observed time stops")
    parser.add_argument("--speed_ratio", type=float, default=1.3)
    parser.add_argument("--radius", type=float, default=0.3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    found = {"options": {**vars(options), "json": None}, "machine": describe_machine(), "teams": []}
    for size in options.sizes:
        for fall_outs in (0.0, 1.0) if size > 1 else (0.0,):
            began = time.monotonic()
            found["teams"].append(fly(options, size, fall_outs))
            print(found["teams"][-1], f"{time.monotonic() - began:.0f} s", flush=True)
            write_json(options.json, found)


if __name__ == "__main__":
    main()
