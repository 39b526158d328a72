"""How evaders that plan get away: `python -m experiments.evaders.escapes --json FILE [--clock S]`.

Records where everybody is in episodes against a planner, and says of the episodes without a
capture, second by second, how fast the pursuers fly, how near they are, whether they see the
evader, and how they stand round it. With `--opponent`, a file of `openjax exploit`, that evader
flies, not a planner. With `--clock` the time that the pursuers observe stands still from then on,
and the planner knows it.
"""

import argparse
import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from experiments.evaders.judged_game import JudgedGame, game_parser, judged_game
from openjax.evaluation.judges.duel import Duel, World
from openjax.evaluation.judges.planner import Planner
from openjax.evaluation.judges.receding_horizon import RecedingHorizon
from openjax.evaluation.judges.settings import PlannerSettings
from openjax.files import write_json
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, PursuitSettings, PursuitState
from openjax.store.environments import make_environment

TIME = slice(16, 20)
"""Where t/T stands in a pursuer's own part of the observation."""


@struct.dataclass
class Moment:
    """What is kept of a world: T moments of B worlds with N pursuers."""

    pursuers: jax.Array  # (T, B, N, 3) m
    velocity: jax.Array  # (T, B, N, 3) m/s, the pursuers'
    evader: jax.Array  # (T, B, 3) m
    in_sight: jax.Array  # (T, B, N) bool, who sees the evader
    captured: jax.Array  # (T, B) bool, by now


@dataclass(frozen=True, eq=False)
class StoppedClock:
    """A policy that is shown a time which stands still."""

    policy: Policy
    stops: float
    """As a share of the episode."""

    def act(self, parameters: PolicyParameters, observation: Observation) -> jax.Array:
        """Actions (B, N, 4) of observations (B, ...)."""
        own = observation.self_state
        late = jnp.maximum(own[..., TIME.start : TIME.start + 1] - self.stops, 0.0)
        frames = observation.frames
        past = jnp.maximum(frames[..., 0] - late[..., 0, :], 0.0)
        shown = observation.replace(
            self_state=own.at[..., TIME].add(-late), frames=frames.at[..., 0].set(past)
        )
        return self.policy.act(parameters, shown)


def moment(state: PursuitState) -> Moment:
    """What is kept of worlds (B, ...)."""
    drones = state.drones
    return Moment(
        pursuers=drones.position,
        velocity=drones.velocity,
        evader=state.evader_position,
        in_sight=state.sees,
        captured=state.statistics.captured,
    )


@struct.dataclass
class Flying:
    """B worlds on their way."""

    world: World


@dataclass(frozen=True, eq=False)
class OwnRule(RecedingHorizon):
    """An evader that flies by its own rule, looked at as often as one that plans."""

    settings: PlannerSettings
    duel: Duel

    def begin(self, start: World) -> Flying:
        """Worlds (B, ...) at the start of an episode."""
        return Flying(start)

    def replan(self, parameters: PolicyParameters, carry: Flying, key: jax.Array) -> Flying:
        """The same a tenth of a second later."""
        del key
        wish = jnp.full_like(carry.world[1].evader_position, jnp.nan)
        steps = self.settings.replan
        return Flying(self.duel.fly(parameters, carry.world, wish, steps))


def record(evaders: RecedingHorizon, parameters, tasks, key) -> Moment:
    """An episode of the evaders on each of tasks (B, ...), a moment each time they plan."""
    start = evaders.duel.start(tasks, key)
    return evaders.fly_and_keep(parameters, start, key, moment)[1]


def open_angle(moments: Moment) -> np.ndarray:
    """(T, B) degrees, the widest angle from above between neighbouring pursuers round the evader."""
    offset = moments.pursuers - moments.evader[:, :, None]
    angle = np.sort(np.arctan2(offset[..., 1], offset[..., 0]), axis=-1)
    turn = np.concatenate([angle, angle[..., :1] + 2 * np.pi], axis=-1)
    return np.degrees(np.diff(turn, axis=-1).max(-1))


def summary(moments: Moment, game: PursuitSettings, replan: int) -> dict:
    """Of one kind of tasks: captures, and medians over the episodes without one, for each second."""
    free = ~moments.captured[-1]
    found = {"episodes": len(free), "captures": int((~free).sum())}
    if not free.any():
        return found
    height = moments.pursuers[..., 2]
    side = np.sign(height - moments.evader[..., None, 2])
    offset = moments.pursuers - moments.evader[:, :, None]
    second = round(1.0 / (game.time_step * replan))
    way = np.linalg.norm(np.diff(moments.evader, axis=0), axis=-1)
    values = {
        "evader_speed": second * np.concatenate([way[:1], way]),
        "second_nearest": np.sort(np.linalg.norm(offset, axis=-1), axis=-1)[..., 1],
        "speed": np.linalg.norm(moments.velocity, axis=-1).mean(-1),
        "nearest": np.linalg.norm(offset, axis=-1).min(-1),
        "open_angle": open_angle(moments),
        "spread_in_height": np.ptp(height, axis=-1),
    }
    shares = {
        "seen": moments.in_sight.any(-1),
        "all_above_or_below": np.abs(side.sum(-1)) == side.shape[-1],
    }

    def each_second(value, over):
        parts = value[:, free].reshape(-1, second, free.sum())
        return over(parts, axis=(1, 2)).round(3).tolist()

    found |= {name: each_second(value, np.median) for name, value in values.items()}
    return found | {name: each_second(value, np.mean) for name, value in shares.items()}


def escapes_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = game_parser(__doc__, episodes=10, uniform=24)
    parser.add_argument("--plans", type=int, default=PlannerSettings().plans)
    parser.add_argument("--clock", type=float, help="seconds after which the observed time stops")
    parser.add_argument("--opponent", help="file of a learned evader")
    return parser


def evaders_of(game: JudgedGame) -> RecedingHorizon:
    """Who flies away from the game's policy, as the options say."""
    options = game.options
    environment = game.environment
    settings = environment.settings
    policy = game.loaded.policy
    if options.clock is not None:
        length = settings.episode_length * settings.time_step
        policy = StoppedClock(policy, options.clock / length)
    planning = PlannerSettings(options.plans)
    if not options.opponent:
        return Planner(planning, Duel(environment, policy))
    environment = make_environment(settings, options.vehicle, options.effects, options.opponent)
    return OwnRule(planning, Duel(environment, policy))


def main() -> None:
    """The command."""
    options = escapes_parser().parse_args()
    game = judged_game(options)
    settings = game.environment.settings
    evaders = evaders_of(game)
    fly = jax.jit(lambda *arguments: record(evaders, *arguments))
    found = {
        **game.flown,
        "plans": None if options.opponent else options.plans,
        "opponent": options.opponent,
        "clock": options.clock,
        "kinds": {},
    }
    replan = evaders.settings.replan
    for kind, tasks in game.part(game.tasks).items():
        began = time.monotonic()
        flown = fly(game.loaded.parameters, tasks, jax.random.key(options.seed))
        flown = jax.tree.map(np.asarray, flown)
        own = summary(flown, settings, replan)
        found["kinds"][kind] = own
        seconds = time.monotonic() - began
        print(f"{kind}, {seconds:.0f} s: {own['captures']} of {own['episodes']} caught", flush=True)
        write_json(options.json, found)


if __name__ == "__main__":
    main()
