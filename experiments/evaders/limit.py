"""What can be held at all: `python -m experiments.evaders.limit --json FILE`.

Both sides plan in the true simulation, the pursuers with the policy among their plans;
records as `openjax exploit --json` writes them, of the game in which the pursuers
choose last, which bounds the captures from above, and of the one in which the evader
does.
"""

import argparse
import dataclasses
import functools

import jax
import jax.numpy as jnp

from experiments.evaders.judged_game import JudgedGame, game_parser, judged_game
from experiments.evaders.matrix_game import MatrixGame, MatrixGameSettings, VelocityFlight, Ways
from experiments.evaders.points import Points, Team
from openjax.baselines.surroundings import Craft
from openjax.baselines.velocity_controller import velocity_action
from openjax.evaluation.judges.duel import Duel
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.shortest_paths import path_length, shortest_paths
from openjax.vehicle import hover_share

SIDES = ("pursuers", "evader")
HONEST = ", honest sight"
"""What is added to a name where pursuers that plan don't see through pillars ..."""
POINTS = ", points"
"""... and where they have no inertia."""


def vehicles_flight(environment: Pursuit) -> VelocityFlight:
    """How quadrotors fly velocities, from their true state."""
    settings = environment.settings
    with jax.ensure_compile_time_eval():  # it may be made inside a compiled program
        hover = float(hover_share(environment.vehicle))
    craft = Craft(settings.arena_radius, settings.arena_height, hover_thrust=hover)

    def action(observation, state, velocity):
        drones = state.drones
        known = jnp.concatenate([drones.position, drones.quaternion, drones.velocity], axis=-1)
        return velocity_action(craft, observation.replace(self_state=known), velocity)

    return action


def ways_round_pillars(settings: PursuitSettings) -> Ways:
    """Shortest paths that keep clear of the pillars."""

    def length(task, paths, position, target):
        return path_length(settings, task, paths, position[None], target)[0]

    return Ways(functools.partial(shortest_paths, settings), length)


def points_in(game: JudgedGame) -> tuple[Duel, VelocityFlight]:
    """The same tasks with pursuers that have no inertia; in the policy's place they
    stay where they are.
    """
    settings = game.environment.settings
    points = Points(settings.max_speed, settings.time_step)
    environment = dataclasses.replace(game.environment, dynamics=points)

    def flight(observation, state, velocity):
        return jnp.pad(velocity / settings.max_speed, ((0, 0), (1, 0)))

    def stay(observation):
        return jnp.zeros_like(observation.self_state[..., :3])

    return Duel(environment, Team(stay)), flight


def limit_parser() -> argparse.ArgumentParser:
    """The options."""
    defaults = MatrixGameSettings()
    parser = game_parser(__doc__, episodes=16, uniform=48)
    parser.add_argument("--plans", type=int, default=defaults.team_plans, help="of the pursuers")
    parser.add_argument(
        "--direct_plans", type=int, default=defaults.direct_plans, help="beside, without the policy"
    )
    parser.add_argument("--evader_plans", type=int, help="by default as many as --plans")
    parser.add_argument("--pieces", type=int, default=defaults.pieces, help="of .2 s, of each plan")
    parser.add_argument("--last", choices=SIDES, nargs="*", default=SIDES, help="who knows all")
    parser.add_argument(
        "--sight", choices=("full", "honest"), default="full", help="of pursuers that plan"
    )
    parser.add_argument("--points", action="store_true", help="pursuers without inertia")
    return parser


def main() -> None:
    """The command."""
    options = limit_parser().parse_args()
    game = judged_game(options)
    if options.points:
        duel, flight = points_in(game)
    else:
        duel = Duel(game.environment, game.loaded.policy)
        flight = vehicles_flight(game.environment)
    found = {**game.flown, "sight": options.sight, "plans": {}, "records": [], "seconds": {}}
    ways = ways_round_pillars(game.environment.settings)
    for side in options.last:
        name = f"both plan, {side} last" + HONEST * (options.sight == "honest")
        name += POINTS * options.points
        settings = MatrixGameSettings(
            side == "pursuers",
            evader_plans=options.evader_plans or options.plans,
            team_plans=options.plans,
            direct_plans=options.direct_plans,
            pieces=options.pieces,
            full_sight=options.sight == "full",
        )
        found["plans"][name] = dataclasses.asdict(settings)
        both = MatrixGame(settings, duel, flight, ways)

        def fly(parameters, tasks, key, both=both):
            return both.fly(parameters, duel.start(tasks, key), key)

        if options.slots:
            game.replanned_kept(name, both, found, options.json)
        else:
            game.records_kept(name, fly, found, options.json)


if __name__ == "__main__":
    main()
