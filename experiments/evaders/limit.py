"""What can be held at all: `python -m experiments.evaders.limit --json FILE`.

Both sides plan in the true simulation, the pursuers with the policy among their plans; records as
`openjax exploit --json` writes them, of the game in which the pursuers choose last, which bounds
the captures from above, and of the one in which the evader does.
"""

import time

import jax
import jax.numpy as jnp

from experiments.evaders.judged_game import game_parser, judged_game
from openjax.baselines.surroundings import Craft
from openjax.baselines.velocity_controller import velocity_action
from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.matrix_game import MatrixGame, VelocityFlight
from openjax.evaluation.judges.settings import MatrixGameSettings
from openjax.files import write_json
from openjax.pursuit import Pursuit
from openjax.vehicle import hover_share

LAST = {"both plan, pursuers last": True, "both plan, evader last": False}
HONEST = ", honest sight"
"""What is added to a name where pursuers that plan don't see through pillars."""


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


def main() -> None:
    """The command."""
    parser = game_parser(__doc__, episodes=16, uniform=48)
    parser.add_argument("--plans", type=int, default=16, help="of the pursuers")
    parser.add_argument("--evader_plans", type=int, help="by default as many")
    parser.add_argument(
        "--sight", choices=("full", "honest"), default="full", help="of pursuers that plan"
    )
    options = parser.parse_args()
    game = judged_game(options)
    duel = Duel(game.environment, game.loaded.policy)
    found = {**game.flown, "sight": options.sight, "records": [], "seconds": {}}
    for name, pursuers_last in LAST.items():
        settings = MatrixGameSettings(
            pursuers_last,
            evader_plans=options.evader_plans or options.plans,
            team_plans=options.plans,
            full_sight=options.sight == "full",
        )
        both = MatrixGame(settings, duel, vehicles_flight(game.environment))

        def fly(parameters, tasks, key, both=both):
            return both.fly(parameters, duel.start(tasks, key), key)

        began = time.monotonic()
        own = game.records(name + HONEST * (options.sight == "honest"), fly)
        found["seconds"][name] = time.monotonic() - began
        found["records"] += own
        rates = ", ".join(f"{one['scenario']} {one['capture_rate']:.2f}" for one in own)
        print(f"{name}, {found['seconds'][name]:.0f} s: {rates}", flush=True)
        write_json(options.json, found)


if __name__ == "__main__":
    main()
