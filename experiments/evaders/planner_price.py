"""What a planner's strength costs: `python -m experiments.evaders.planner_price --json
FILE`.

Planners of several settings fly the same tasks against one policy, each in a program
that is compiled before its seconds count. With `--opponent`, a file of `openjax
exploit`, some of them also try what a learned evader would do. Prints a line for each;
the JSON has records as `openjax exploit --json` writes them.
"""

import time

import jax
import numpy as np

from experiments.evaders.judged_game import JudgedGame, game_parser, judged_game
from openjax.background import compile_ahead
from openjax.commands.exploit_evaders import record
from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.planner import Planner
from openjax.evaluation.judges.settings import PlannerSettings
from openjax.files import write_json
from openjax.store.environments import make_environment

SHORT = {"pieces": 8, "piece_steps": 10}
"""As far ahead in pieces as long as the time between two plans: the last plan goes on
exactly.
"""
PLANNERS = {
    "shipped": {},
    "24 plans": {"plans": 24},
    "96 plans": {"plans": 96},
    "192 plans": {"plans": 192},
    "every .05 s": {"replan": 5},
    "every .2 s": {"replan": 20},
    "ahead .5 s": {"pieces": 5, "piece_steps": 10},
    "ahead 1.2 s": {"pieces": 6},
    "ahead 1.6 s": {"pieces": 8},
    "short pieces": SHORT | {"turn": 0.25},
    "short, refined": SHORT | {"turn": 0.25, "refined": 0.5},
    "short, refined, ahead 1.2 s": {"pieces": 12, "piece_steps": 10, "turn": 0.2, "refined": 0.5},
    "refined": {"refined": 0.5},
    "where pursuers are": {"ahead": 0.0},
    "where they are in .3 s": {"ahead": 0.3},
}
WITH_OPPONENT = {
    "and its own rule": {"own_rule": 0.5},
    "short, refined, and its own rule": SHORT | {"turn": 0.25, "refined": 0.3, "own_rule": 0.5},
    "12 plans and its own rule": {"plans": 12, "own_rule": 0.5},
    "ahead 1.6 s, and its own rule": {"pieces": 8, "own_rule": 0.5},
}


def planners_of(options) -> dict[str, dict]:
    """The settings that are flown, by name."""
    known = PLANNERS | (WITH_OPPONENT if options.opponent else {})
    return {name: known[name] for name in options.only or known}


def planner_of(game: JudgedGame, settings: PlannerSettings, opponent: str | None) -> Planner:
    """One that tries what a learned evader would do, if its settings say so."""
    environment = game.environment
    if opponent and settings.own_rule:
        own = game.options
        environment = make_environment(environment.settings, own.vehicle, own.effects, opponent)
    return Planner(settings, Duel(environment, game.loaded.policy))


def program(planner: Planner):
    """(parameters, tasks, key) -> statistics (B,), compiled by `jax.jit`."""

    def fly(parameters, tasks, key):
        return planner.fly(parameters, planner.duel.start(tasks, key), key)

    return jax.jit(fly)


def fly_in_slots(game: JudgedGame, planners: dict[str, Planner]) -> None:
    """One after the other, as a CPU does it."""
    found = {**game.flown, "records": [], "seconds": {}}
    for name, planner in planners.items():
        game.replanned_kept(name, planner, found, game.options.json)


def main() -> None:
    """The command."""
    parser = game_parser(__doc__, episodes=50, uniform=128)
    parser.add_argument("--opponent", help="file of a learned evader")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="of the planners; by default all")
    options = parser.parse_args()
    game = judged_game(options)
    key = jax.random.key(options.seed)
    arguments = (game.loaded.parameters, game.tasks, key)
    planners = {
        name: planner_of(game, PlannerSettings(**changes), options.opponent)
        for name, changes in planners_of(options).items()
    }
    if options.slots:
        fly_in_slots(game, planners)
        return
    ready = {
        name: compile_ahead(program(planner), *arguments) for name, planner in planners.items()
    }
    found = {**game.flown, "records": [], "seconds": {}, "planners": {}}
    for name, compiled in ready.items():
        run = compiled()
        began = time.monotonic()
        flown = jax.tree.map(np.asarray, run(*arguments))
        seconds = time.monotonic() - began
        own = [record(name, kind, part) for kind, part in game.part(flown).items()]
        found["records"] += own
        found["seconds"][name] = seconds
        found["planners"][name] = planners_of(options)[name]
        rates = ", ".join(f"{one['scenario']} {one['capture_rate']:.2f}" for one in own)
        hundred = 100 * seconds / len(flown.captured)
        print(f"{name}, {hundred:.1f} s per 100 episodes: {rates}", flush=True)
        write_json(options.json, found)


if __name__ == "__main__":
    main()
